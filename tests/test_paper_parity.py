"""The paper preset gives the released code's numbers at every stage (seeded weights)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import official
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from cvthead.errors import AssetError
from cvthead.model.official_keys import network_state
from cvthead.model.paper import PaperCVTHead
from cvthead.model.positional import sine_code, vertex_code
from cvthead.model.splat import clamped_pixel_index, nearest_points, splat_clamped
from cvthead.official.painted import HARD_MASK, Painted

NETWORK_TOLERANCE = 1e-3  # of the array's standard deviation
SIZE = 256


@pytest.fixture(scope="module")
def reference(shared: Path) -> official.Arrays:
    return official.arrays(shared, "sample_a")


@pytest.fixture(scope="module")
def weights(shared: Path) -> dict[str, Tensor]:
    return official.checkpoint(shared)


@pytest.fixture(scope="module")
def model(shared: Path, weights: dict[str, Tensor]) -> PaperCVTHead:
    model = PaperCVTHead(official.hierarchy(shared)).eval()
    model.load_state_dict(network_state(weights, model.state_dict()))
    return model


@pytest.fixture(scope="module")
def run(shared: Path, model: PaperCVTHead, reference: official.Arrays) -> dict[str, Tensor]:
    """One reenactment, keeping what the reference run kept."""
    seen: dict[str, Tensor] = {}

    def keep(name: str, module: nn.Module) -> None:
        module.register_forward_hook(lambda _module, _inputs, out: seen.update({name: out[0]}))

    for index, layer in enumerate(model.encoder.net):
        keep(f"stage_{index}", layer)
    keep("ae_proj", model.encoder.project)
    keep("image_tokens", model.encoder.to_token)
    model.encoder.to_token.register_forward_pre_hook(
        lambda _module, inputs: seen.update({"patch_vectors": inputs[0][0]})
    )
    model.transformer.register_forward_pre_hook(
        lambda _module, inputs: seen.update({"tokens_in": inputs[0][0]})
    )
    keep("tokens_out", model.transformer)
    keep("level1", model.upsampler.convs[0])
    keep("vtx_feat", model.upsampler)
    keep("unet_raw", model.unet)

    image = torch.from_numpy(official.arrays(shared, "inputs")["src"]).permute(2, 0, 1)
    mask = torch.from_numpy(reference["mask"])[None]
    source = torch.cat([(image / 255 - 0.5) / 0.5, mask.float()])[None]
    with torch.inference_mode():
        descriptors = model.describe(source, batched(reference["src_proj"]))
        model.paint(batched(reference["drv_proj"]), descriptors, SIZE)
    seen["descriptors"] = descriptors[0]
    return seen


def batched(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(array)[None]


def assert_close(found: Tensor, expected: NDArray[Any]) -> None:
    assert found.shape == expected.shape
    error = np.abs(found.numpy() - expected).max() / expected.std()
    assert error < NETWORK_TOLERANCE, f"{error:.1e} standard deviations"


def test_encoder_stages(run: dict[str, Tensor], reference: official.Arrays) -> None:
    found = [run[f"stage_{index}"] for index in range(12)]
    moments = [[x.mean(), x.std(correction=0), x.abs().max()] for x in found]
    expected = reference["ae_stage_mean_std_absmax"]
    error = np.abs(np.array(moments) - expected) / expected[:, 1:2]
    assert error.max() < NETWORK_TOLERANCE
    assert_close(found[-1][::16], reference["ae_out_c16"])


@pytest.mark.parametrize(
    "name", ["ae_proj", "image_tokens", "tokens_in", "tokens_out", "descriptors", "unet_raw"]
)
def test_stage(name: str, run: dict[str, Tensor], reference: official.Arrays) -> None:
    assert_close(run[name], reference[name])


def test_patches_are_row_major(run: dict[str, Tensor], reference: official.Arrays) -> None:
    assert_close(run["patch_vectors"][::16], reference["patch_vectors_t16"])


def test_upsampler(run: dict[str, Tensor], reference: official.Arrays) -> None:
    assert_close(F.elu(run["level1"]), reference["up_level1"])
    assert_close(run["vtx_feat"][::16], reference["vtx_feat_s16"])


def test_positional_codes(model: PaperCVTHead, reference: official.Arrays, shared: Path) -> None:
    coarse = torch.from_numpy(reference["src_proj"])[model.coarse]
    assert torch.equal(coarse, torch.from_numpy(reference["coarse_vertices"]))
    assert_close(vertex_code(coarse, 128), reference["uv_pos"] + reference["depth_pos"])
    assert_close(sine_code((0.5 * coarse[:, 2] + 0.5) * 2 * torch.pi, 128), reference["depth_pos"])
    computed = PaperCVTHead(official.hierarchy(shared)).image_code
    assert_close(computed, reference["pos_embedding"])


def test_splat(reference: official.Arrays) -> None:
    driven = batched(reference["drv_proj"])
    owner = nearest_points(clamped_pixel_index(driven, SIZE), driven[..., 2], SIZE)
    same = (owner[0].reshape(SIZE, SIZE).numpy() + 1) == reference["index_image"]
    assert same.mean() >= 0.999
    image = splat_clamped(driven, batched(reference["descriptors"]), SIZE)[0].numpy()
    assert np.abs(image[0] - reference["depth_image"])[same].max() < 1e-5
    features = reference["feature_image_f16"].astype(np.float32)
    assert np.abs(image[1:] - features)[:, same].max() < 1e-3 * np.abs(features).max()


@pytest.mark.parametrize(("name", "threshold"), [("final_soft", None), ("final_hard", HARD_MASK)])
def test_final_image(
    name: str, threshold: float | None, run: dict[str, Tensor], reference: official.Arrays
) -> None:
    found = Painted(run["unet_raw"].permute(1, 2, 0).numpy()).over_white(threshold)
    error = np.abs(found.astype(int) - reference[name].astype(int))
    assert error.max() <= 1


def test_checkpoint_is_read_strictly(model: PaperCVTHead, weights: dict[str, Tensor]) -> None:
    broken = dict(weights)
    del broken["unet_generator.up_convs.3.norm2.running_var"]
    broken["ae_proj.bias"] = torch.zeros(3)
    broken["autoencoder.net.12.weight"] = torch.zeros(1)
    with pytest.raises(AssetError) as caught:
        network_state(broken, model.state_dict())
    message = str(caught.value)
    assert "unet_generator.up_convs.3.norm2.running_var is missing" in message
    assert "ae_proj.bias has shape (3,), not (256,)" in message
    assert "autoencoder.net.12.weight is unknown" in message
    assert message.count(";") == 2

"""What can be plugged into the loss, with seeded random weights; both stages, all ablations."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from made_loss_networks import made_identity, made_vgg
from made_records import make_records
from torch import Tensor

from cvthead.errors import AssetError, InputError
from cvthead.training.config import TrainConfig
from cvthead.training.discriminator import (
    MultiScaleDiscriminator,
    adversarial_losses,
    discriminator_loss,
)
from cvthead.training.identity import IdentityDistance
from cvthead.training.perceptual import perceptual_weights
from cvthead.training.train import train
from cvthead.training.vgg import VGGDistance

pytestmark = pytest.mark.usefixtures("one_thread")


def views() -> tuple[Tensor, Tensor]:
    torch.manual_seed(2)
    a = torch.rand(2, 3, 64, 64) * 2 - 1
    return a, torch.rand(2, 3, 64, 64) * 2 - 1


@pytest.mark.parametrize("name", ["VGG-16", "VGG-19"])
def test_vgg_distance_is_the_weighted_sum_over_first_maps(name: str, tmp_path: Path) -> None:
    distance = VGGDistance(made_vgg(tmp_path / "vgg.pth", name))
    a, b = views()
    assert torch.equal(distance(a, a), torch.zeros(2))
    # By hand: run the whole network and pick the maps after torchvision's relu1_1 ... relu5_1.
    layers = {"VGG-16": (1, 6, 11, 18, 25), "VGG-19": (1, 6, 11, 20, 29)}[name]
    expected = torch.zeros(2)
    x, y = ((v * 0.5 + 0.5 - distance.mean) / distance.deviation for v in (a, b))
    weights = iter((1 / 32, 1 / 16, 1 / 8, 1 / 4, 1))
    for number, layer in enumerate(distance.features):
        x, y = layer(x), layer(y)
        if number in layers:
            expected += next(weights) * (x - y).abs().mean((1, 2, 3))
    torch.testing.assert_close(distance(a, b), expected)


def test_identity_distance_falls_towards_the_same_face(tmp_path: Path) -> None:
    distance = IdentityDistance(made_identity(tmp_path / "id.pth"))
    a, b = views()
    torch.testing.assert_close(distance(a, a), torch.zeros(2), atol=1e-5, rtol=0)
    moved = a.clone().requires_grad_()
    loss = distance(moved, b)
    assert (loss > 0).all()
    loss.sum().backward()
    assert moved.grad is not None
    assert moved.grad.abs().sum() > 0
    assert all(p.grad is None for p in distance.parameters())


def test_wrong_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no"):
        VGGDistance(tmp_path / "absent.pth")
    with pytest.raises(InputError, match="is not a VGG-16"):
        VGGDistance(made_identity(tmp_path / "id.pth"))
    (tmp_path / "text.pth").write_text("hello")
    with pytest.raises(InputError, match="not a readable state dict"):
        IdentityDistance(tmp_path / "text.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(InputError, match="not a state dict"):
        IdentityDistance(tmp_path / "list.pth")


def test_discriminator_learns_to_tell_and_matching_is_zero_for_equal_views() -> None:
    torch.manual_seed(3)
    discriminator = MultiScaleDiscriminator()
    assert [scale[-1].shape[-1] for scale in discriminator(views()[0])] == [11, 7]
    optimiser = torch.optim.Adam(discriminator.parameters(), 2e-4)
    fake, other = views()
    real = torch.nn.functional.avg_pool2d(other, 9, 1, 4)  # smooth, where the fake is noise
    before = float(discriminator_loss(discriminator(real), discriminator(fake)).detach())
    for _ in range(8):
        optimiser.zero_grad()
        loss = discriminator_loss(discriminator(real), discriminator(fake))
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    assert float(loss.detach()) < 0.5 * before
    maps = discriminator(fake)
    assert adversarial_losses(maps, maps)["feature_matching"] == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("records")
    make_records(path)
    return path


def settings(folder: Path, run: Path, **changes: object) -> TrainConfig:
    values = {"data": folder, "run": run, "size": 64, "steps": 1, "batch": 1, "workers": 0}
    return TrainConfig.model_validate(values | {"log_every": 1} | changes)


@pytest.mark.parametrize("features", ["pixel-aligned", "transformer"])
def test_ablations_train_only_their_own_branch(features: str, folder: Path, tmp_path: Path) -> None:
    try:
        perceptual_weights("alex")
    except AssetError as error:
        pytest.skip(f"no perceptual weights: {error}")
    start = torch.load(
        train(settings(folder, tmp_path / "a", features=features), sitting=1), weights_only=True
    )
    moments = start["optimizer"]["state"]
    trained = {number for number, each in moments.items() if each["exp_avg"].abs().sum() > 0}
    names = [n for n in start["model"] if "running" not in n and "num_batches" not in n]
    moved = {names[number] for number in trained}
    assert any(n.startswith("transformer.") for n in moved) == (features == "transformer")
    assert any(n.startswith("encoder.to_pixels") for n in moved) == (features != "transformer")
    assert any(n.startswith("unet.") for n in moved)


def test_paper_preset_trains_on_pixel_aligned_features(folder: Path, tmp_path: Path) -> None:
    networks = {"perceptual": str(made_vgg(tmp_path / "vgg.pth", "VGG-16"))}
    config = settings(
        folder, tmp_path, preset="paper", features="pixel-aligned", size=32, networks=networks
    )
    state = torch.load(train(config), weights_only=True)
    moved = [moments["exp_avg"].abs().sum() > 0 for moments in state["optimizer"]["state"].values()]
    assert any(name.startswith("extractor.") for name in state["model"])
    assert not any(name.startswith("transformer.") for name in state["model"])
    # A convolution before a batch norm has a bias without effect.
    assert sum(moved) > len(moved) / 2


def test_paper_preset_trains_in_both_stages(folder: Path, tmp_path: Path) -> None:
    """VGG, identity, Dice and L1, then the adversary too, from the first stage's weights."""
    common: dict[str, object] = {
        "preset": "paper",
        "networks": {
            "perceptual": str(made_vgg(tmp_path / "vgg.pth", "VGG-16")),
            "identity": str(made_identity(tmp_path / "id.pth")),
        },
    }
    first = train(settings(folder, tmp_path / "1", losses={"identity": 0.1}, **common))
    weights = {"identity": 0.1, "adversarial": 0.1, "feature_matching": 1.0}
    second = train(
        settings(folder, tmp_path / "2", stage=2, init=str(first), losses=weights, **common)
    )
    before, after = (torch.load(path, weights_only=True) for path in (first, second))
    assert "discriminator" not in before
    assert set(after["running"]) == {
        *("l1", "perceptual", "dice", "identity"),
        *("adversarial", "feature_matching", "discriminator"),
    }
    assert set(before["running"]) == {"l1", "perceptual", "dice", "identity"}
    assert after["discriminator_optimizer"]["state"]
    name = "unet.to_image.weight"
    change = (after["model"][name] - before["model"][name]).abs().max()
    assert 0 < change < 1e-3  # one step of Adam away from the first stage

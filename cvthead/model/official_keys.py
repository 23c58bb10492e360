"""Names of the released checkpoint's network tensors, as a pure function of ours."""

from __future__ import annotations

import re
from collections.abc import Mapping

from torch import Tensor

from cvthead.errors import AssetError

# Ours (the whole name) -> theirs. The first rule that matches wins.
RULES = tuple(
    (re.compile(pattern), official)
    for pattern, official in (
        (r"image_code", r"pos_embedding"),
        (r"vertex_query", r"vtx_query"),
        (r"encoder\.net\.(.+)", r"autoencoder.net.\1"),
        (r"encoder\.project\.(\w+)", r"ae_proj.\1"),
        (r"encoder\.to_token\.(\w+)", r"patch_to_embedding.\1"),
        (r"(transformer\.layers\.\d+\.[01]\.norm\.\w+)", r"\1"),
        (r"transformer\.layers\.(\d+)\.0\.to_qkv\.(\w+)", r"transformer.layers.\1.0.fn.to_qkv.\2"),
        (
            r"transformer\.layers\.(\d+)\.0\.to_out\.(\w+)",
            r"transformer.layers.\1.0.fn.to_out.0.\2",
        ),
        (r"transformer\.layers\.(\d+)\.1\.inner\.(\w+)", r"transformer.layers.\1.1.fn.net.0.\2"),
        (r"transformer\.layers\.(\d+)\.1\.outer\.(\w+)", r"transformer.layers.\1.1.fn.net.3.\2"),
        (r"upsampler\.convs\.([01])\.linear\.(\w+)", r"vtx_upsampler.de_layers.\1.conv.layer.\2"),
        (r"upsampler\.convs\.2\.linear\.(\w+)", r"vtx_upsampler.de_layers.2.layer.\1"),
        (r"to_descriptor\.(\w+)", r"vtx_descriptor_head.0.\1"),
        (r"unet\.downs\.(\d)\.0\.conv\.(\w+)", r"unet_generator.down_convs.\1.conv1.\2"),
        (r"unet\.downs\.(\d)\.1\.conv\.(\w+)", r"unet_generator.down_convs.\1.conv2.\2"),
        (r"unet\.downs\.(\d)\.([01])\.norm\.(\w+)", r"unet_generator.down_convs.\1.norm\2.\3"),
        (r"unet\.ups\.(\d)\.reduce\.conv\.(\w+)", r"unet_generator.up_convs.\1.upconv.\2"),
        (r"unet\.ups\.(\d)\.merge\.conv\.(\w+)", r"unet_generator.up_convs.\1.conv1.\2"),
        (r"unet\.ups\.(\d)\.refine\.conv\.(\w+)", r"unet_generator.up_convs.\1.conv2.\2"),
        (r"unet\.ups\.(\d)\.reduce\.norm\.(\w+)", r"unet_generator.up_convs.\1.norm0.\2"),
        (r"unet\.ups\.(\d)\.merge\.norm\.(\w+)", r"unet_generator.up_convs.\1.norm1.\2"),
        (r"unet\.ups\.(\d)\.refine\.norm\.(\w+)", r"unet_generator.up_convs.\1.norm2.\2"),
        (r"unet\.to_image\.(\w+)", r"unet_generator.conv_final.\1"),
    )
)
# Tables that the released code stores with a leading batch of one.
BATCHED = ("image_code", "vertex_query")
# Parts of the released checkpoint that are not the network of PaperCVTHead.
OTHER_PARTS = ("face_parsing.", "hair_model.", "deca.", "deform_mean", "deform_basis")


def official_name(name: str) -> str:
    """The released checkpoint's name for an entry of ``PaperCVTHead.state_dict()``.

    Raises:
        KeyError: no such entry.
    """
    for pattern, official in RULES:
        match = pattern.fullmatch(name)
        if match:
            return match.expand(official)
    raise KeyError(name)


def network_state(
    official: Mapping[str, Tensor], model_state: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The released checkpoint's network under our names.

    Args:
        official: the checkpoint's ``model`` entry, whole.
        model_state: ``PaperCVTHead.state_dict()``, for the shapes.

    Returns:
        A state for ``PaperCVTHead.load_state_dict``; shares memory with ``official``.

    Raises:
        AssetError: names every missing, extra and mis-shaped key.
    """
    state = {}
    problems = []
    names = {official_name(name): name for name in model_state}
    for theirs, name in names.items():
        shape = tuple(model_state[name].shape)
        if name in BATCHED:
            shape = (1, *shape)
        if theirs not in official:
            problems.append(f"{theirs} is missing")
        elif tuple(official[theirs].shape) != shape:
            problems.append(f"{theirs} has shape {tuple(official[theirs].shape)}, not {shape}")
        else:
            value = official[theirs]
            state[name] = value[0] if name in BATCHED else value
    problems += [
        f"{theirs} is unknown"
        for theirs in official
        if theirs not in names and not theirs.startswith(OTHER_PARTS)
    ]
    if problems:
        raise AssetError(
            "this is not the released CVTHead checkpoint: " + "; ".join(problems),
            hint="pass cvthead.pt as released, of the official repository",
        )
    return state

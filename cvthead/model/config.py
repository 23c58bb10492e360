"""One configuration, two presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Features = Literal["fused", "pixel-aligned", "transformer"]


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the network; the fields follow the paper's symbols (section 3 and 4.1).

    Attributes:
        image_size: H = W of source crop and rendered frame, pixels.
        descriptor_size: C, channels of a vertex descriptor.
        token_size: C', width of image and vertex tokens.
        token_grid: image tokens per side after the encoder (h = w).
        depth: transformer encoder layers.
        heads: attention heads H.
        mlp_size: hidden width of a transformer MLP.
        upsampler_sizes: output widths of the spiral convolutions; the first two unpool one level
            of the mesh each, any further one stays on the full mesh.
        encoder: "rome" is the paper's weight-standardised encoder, "pyramid" a light one that
            also yields pixel-aligned features.
        pixel_aligned_size: channels sampled at each point's projection; 0 leaves the branch out.
        point_embedding_size: learned channels per mesh vertex in the pixel-aligned branch.
        unet_sizes: widths of the U-Net from the finest level to the coarsest.
        unet_unshuffle: splat and U-Net work at 1/unet_unshuffle of the image size.
        features: what the open preset's descriptors are made of; the other two are ablations:
            "pixel-aligned" samples the encoder's U-Net at every point's projection, seen or not,
            as S3F does, carries the portrait to every point in the same way, and has no
            transformer; "transformer" has no pixel-aligned features, nor
            the warped portrait, as in the paper.
    """

    image_size: int
    descriptor_size: int
    token_size: int
    token_grid: int
    depth: int
    heads: int
    mlp_size: int
    upsampler_sizes: tuple[int, ...]
    encoder: str
    pixel_aligned_size: int
    point_embedding_size: int
    unet_sizes: tuple[int, ...]
    unet_unshuffle: int
    features: Features = "fused"


PAPER = ModelConfig(
    image_size=256,
    descriptor_size=32,
    token_size=128,
    token_grid=16,
    depth=6,
    heads=4,
    mlp_size=256,
    upsampler_sizes=(128, 128, 128),
    encoder="rome",
    pixel_aligned_size=0,
    point_embedding_size=0,
    unet_sizes=(32, 64, 128, 256, 512),
    unet_unshuffle=1,
)

OPEN = ModelConfig(
    image_size=256,
    descriptor_size=16,
    token_size=128,
    token_grid=16,
    depth=4,
    heads=4,
    mlp_size=256,
    upsampler_sizes=(64, 48),
    encoder="pyramid",
    pixel_aligned_size=24,
    point_embedding_size=12,
    unet_sizes=(48, 64, 96, 160, 192),
    unet_unshuffle=2,
)

"""Portraits and presets, as every command that makes an avatar takes them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.preset import PRESETS, AnyAvatar, Preset, load_avatar


def add_portrait_options(parser: argparse.ArgumentParser, name: str, what: str) -> None:
    parser.add_argument(name, type=Path, metavar=name.upper(), help=what)
    parser.add_argument(
        "--face", type=int, metavar="N", help="which face, 0 = largest (default: the largest)"
    )
    add_preset_option(parser)


def add_preset_option(
    parser: argparse.ArgumentParser, *, default: str | None = "open", shown: str = "open"
) -> None:
    parser.add_argument(
        "--preset",
        type=preset,
        default=default,
        help=f"model to use, open or official after `cvthead import-official` (default: {shown})",
    )


def add_model_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model",
        type=Path,
        metavar="FOLDER",
        help="another model of the preset, such as `cvthead finetune` writes",
    )


def preset(name: str) -> str:
    """Parse ``--preset``.

    Raises:
        InputError: no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"there is no preset {name!r}", hint="use " + " or ".join(PRESETS))
    return name


def read_avatar(pipeline: Preset[Any], path: Path, face: int | None) -> Any:
    """An avatar of the pipeline's preset, from an avatar file or by encoding a portrait.

    Raises:
        CVTHeadError: the file cannot be read or is of another preset, or it shows no usable face.
    """
    if path.suffix.lower() != ".avatar":
        return pipeline.encode(read_image(path), face=face)
    avatar = load_avatar(path)
    check_preset(path, avatar, pipeline.preset)
    return avatar


def check_preset(path: Path, avatar: AnyAvatar, preset: str) -> None:
    """Refuse the avatar of a file unless it is of a preset."""
    if avatar.preset != preset:
        raise InputError(
            f"{path} is of the preset {avatar.preset}", hint=f"use --preset {avatar.preset}"
        )

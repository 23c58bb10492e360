"""Portraits and presets, as every command that makes an avatar takes them."""

from __future__ import annotations

import argparse
from pathlib import Path

from cvthead.avatar import Avatar
from cvthead.errors import InputError
from cvthead.images import read_image
from cvthead.pipeline import Pipeline


def add_portrait_options(parser: argparse.ArgumentParser, name: str, what: str) -> None:
    parser.add_argument(name, type=Path, metavar=name.upper(), help=what)
    parser.add_argument(
        "--face", type=int, metavar="N", help="which face, 0 = largest (default: the largest)"
    )
    add_preset_option(parser)


def add_preset_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--preset", type=preset, default="open", help="model to use (default and only one: open)"
    )


def preset(name: str) -> str:
    """Parse ``--preset``.

    Raises:
        InputError: not available.
    """
    if name == "official":
        raise InputError(
            "the official preset is not available in this version", hint="use --preset open"
        )
    if name != "open":
        raise InputError(f"there is no preset {name!r}", hint="use --preset open")
    return name


def read_avatar(pipeline: Pipeline, path: Path, face: int | None) -> Avatar:
    """An avatar from an avatar file, or from a portrait by encoding it.

    Raises:
        CVTHeadError: the file cannot be read, or shows no usable face.
    """
    if path.suffix.lower() == ".avatar":
        return Avatar.load(path)
    return pipeline.encode(read_image(path), face=face)

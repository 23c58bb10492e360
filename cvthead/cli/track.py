"""``cvthead track``: coefficients of the face in a picture."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvthead.cli.picture import IMAGE_FORMATS, check_output, write_picture
from cvthead.cli.portrait import add_preset_option
from cvthead.coefficients import JOINTS
from cvthead.files import write_file
from cvthead.images import read_image
from cvthead.preset import FaceTracker, load_preset
from cvthead.provenance import SourceType
from cvthead.tracking.networks import BLENDSHAPE_NAMES
from cvthead.tracking.tracker import TrackedFace, Tracker

STANDARD_OUTPUT = "-"
MESH_COLOUR = (0, 200, 255)
LANDMARK_COLOUR = (255, 80, 60)


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "track",
        help="measure the coefficients of a face",
        description="Fit the head model to the face in a picture and report the fit.",
    )
    parser.add_argument("image", type=Path, metavar="IMAGE", help="PNG, JPEG or WebP picture")
    parser.add_argument(
        "--face", type=int, metavar="N", help="which face, 0 = largest (default: the largest)"
    )
    add_preset_option(parser)
    parser.add_argument(
        "--overlay",
        type=Path,
        metavar="PICTURE",
        help="write the picture with the fitted mesh and the 478 landmarks drawn over it",
    )
    parser.add_argument(
        "--json",
        nargs="?",
        const=STANDARD_OUTPUT,
        metavar="FILE",
        help="write all results as JSON, to standard output if no file is named; "
        "`cvthead animate --driving` takes such a file",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    if args.overlay is not None:
        check_output(args.overlay, tuple(IMAGE_FORMATS), alpha=False)
    image = read_image(args.image)
    # Of the open preset the tracker alone, without the renderer's networks.
    tracker = Tracker.load() if args.preset == "open" else load_preset(args.preset).tracker
    face = tracker.track(image, face=args.face)
    if args.overlay is not None:
        drawn = overlay(tracker, image, face)
        write_picture(args.overlay, drawn, SourceType.COMPOSITE)
    if args.json == STANDARD_OUTPUT:
        print(json.dumps(report(tracker, face), indent=1))
        return
    if args.json is not None:
        write_file(args.json, json.dumps(report(tracker, face), indent=1).encode())
    print(summary(face))
    for path in (args.overlay, args.json):
        if path is not None:
            print(path)


def summary(face: TrackedFace) -> str:
    """One line for people."""
    left, top, right, bottom = face.box
    return (
        f"face {right - left:.0f} x {bottom - top:.0f} px at {left:.0f},{top:.0f}; "
        f"yaw {face.yaw:.0f} degrees; presence {face.presence:.2f}; "
        f"landmark error {face.error:.2f} % of the eye distance"
    )


def report(tracker: FaceTracker, face: TrackedFace) -> dict[str, Any]:
    """Everything that was measured.

    ``frames`` has the form of cvthead/cli/motion_file.py, without the shape, so that a portrait
    driven by it keeps its identity. ``tracked``: ``camera`` and ``landmarks`` in image pixels,
    ``arkit`` are the scores of the blendshape network, ``error`` is in percent of the head's
    outer-eye distance.
    """
    coefficients = face.coefficients
    scores = zip(BLENDSHAPE_NAMES, tracker.networks.blendshapes(face.landmarks), strict=True)
    frame: dict[str, Any] = {"expression": _rounded(coefficients.expression)}
    frame |= {joint: _rounded(coefficients.joint(joint)) for joint in JOINTS}
    return {
        "frames": [frame],
        "tracked": {
            "shape": _rounded(coefficients.shape),
            "camera": {
                "scale": face.camera.scale,
                "tx": face.camera.tx,
                "ty": face.camera.ty,
            },
            "box": _rounded(np.array(face.box)),
            "presence": round(float(face.presence), 4),
            "yaw_degrees": round(face.yaw, 2),
            "error": round(float(face.error), 3),
            "arkit": {name: round(float(s), 4) for name, s in scores if name != "_neutral"},
            "landmarks": [_rounded(point) for point in face.landmarks],
        },
    }


def overlay(tracker: FaceTracker, image: NDArray[np.uint8], face: TrackedFace) -> NDArray[np.uint8]:
    """The picture with the front of the fitted mesh and the landmarks."""
    head = tracker.head
    points = face.camera.project(head.vertices(face.coefficients))[:, :2].astype(np.float64)
    corner = points[head.faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    # Counter-clockwise seen from outside; the image's y axis points down and flips the sign.
    front = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    shift = 4  # OpenCV's fixed-point fraction bits; its pixel centres are at whole numbers

    def fixed(xy: NDArray[np.float64]) -> NDArray[np.int32]:
        return np.asarray(np.rint((xy - 0.5) * 2**shift), np.int32)

    mesh = cv2.polylines(
        image.copy(), list(fixed(corner[front])), True, MESH_COLOUR, 1, cv2.LINE_AA, shift
    )
    result = cv2.addWeighted(image, 0.6, mesh, 0.4, 0)
    radius = max(1, round((face.box[2] - face.box[0]) / 250)) << shift
    for x, y in fixed(face.landmarks[:, :2]):
        cv2.circle(result, (int(x), int(y)), radius, LANDMARK_COLOUR, -1, cv2.LINE_AA, shift)
    return result.astype(np.uint8, copy=False)


def _rounded(values: NDArray[np.floating]) -> list[float]:
    return [round(float(value), 5) for value in values]

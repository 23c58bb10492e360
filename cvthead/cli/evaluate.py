"""``cvthead evaluate``: the quality measures of docs/evaluation.md on held-out people."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from cvthead.cli.portrait import add_preset_option
from cvthead.data.layout import SPLITS
from cvthead.deformation import DeformationModel
from cvthead.errors import AssetError, InputError
from cvthead.official.manifest import Manifest
from cvthead.preset import Preset, load_preset
from cvthead.runtime.model_folder import ModelFolder

T = TypeVar("T")

PARTS = {
    "self": "self-reenactment, unseen pixels, motion",
    "big": "big poses",
    "cross": "cross-identity and turned heads",
    "steady": "steadiness",
    "sources": "two sources of one person",
    "groups": "stills by group",
    "speed": "frames per second as the paper counts them",
}
NETWORKS = {
    "lpips": "distance of two pictures",
    "fid": "features of a picture",
    "csim": "embedding of an aligned face, for the paper's CSIM",
    "iqa": "quality of a picture",
}
COUNTS = {
    "every": (1, "take every n-th clip and still"),
    "drivers": (8, "driving frames per clip"),
    "crossings": (4, "drivers of other people per source"),
    "runs": (1000, "runs of the measurement of speed"),
    "people": (8, "people on the page"),
}


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="measure the quality on held-out people",
        description="Measure trained networks against copying the source and a vertex-coloured "
        "mesh. Prints tables in Markdown and writes report.md, report.json and a page of pictures, "
        "index.html. docs/evaluation.md says what each figure means. Parts: "
        + "; ".join(f"{name}, {what}" for name, what in PARTS.items())
        + ".",
    )
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="with clips/val and stills/val, or of videos; VoxCeleb's layouts are understood",
    )
    parser.add_argument(
        "--split",
        choices=SPLITS,
        help="of a folder of videos only the people whom `cvthead data prepare` puts into this "
        "split by default",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("local/evaluation"), metavar="FOLDER"
    )
    add_preset_option(parser)
    parser.add_argument(
        "--model",
        action="append",
        default=[],
        metavar="NAME=FOLDER",
        help="a trained model of the preset, or another import of the official one, instead of "
        "the one that the preset loads; repeat to compare",
    )
    parser.add_argument(
        "--without-deformation",
        action="store_true",
        help="also every model without hair and shoulders",
    )
    parser.add_argument(
        "--only", action="append", choices=PARTS, metavar="PART", help="repeat for several parts"
    )
    for name, (number, what) in COUNTS.items():
        parser.add_argument(
            f"--{name}", type=int, default=number, metavar="N", help=f"{what} ({number})"
        )
    for name, what in NETWORKS.items():
        parser.add_argument(
            f"--{name}-network", type=Path, metavar="FILE.onnx", help=f"your network: {what}"
        )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    for name in COUNTS:
        if getattr(args, name) < 1:
            raise InputError(f"--{name} is {getattr(args, name)}", hint="use 1 or more")
    if find_spec("torch") is None:
        raise InputError("evaluation needs torch", hint='install with pip install "cvthead[train]"')
    # PyTorch takes seconds to load and is not installed everywhere.
    from cvthead.evaluation.clip import Bench
    from cvthead.evaluation.identity import dlib_embedder
    from cvthead.evaluation.methods import baselines, trained
    from cvthead.evaluation.metrics import Metrics
    from cvthead.evaluation.paper_metrics import UserNetworks
    from cvthead.evaluation.run import Plan, evaluate
    from cvthead.points import PointLayout
    from cvthead.tracking.tracker import Tracker
    from cvthead.training.perceptual import STLPIPS

    networks = UserNetworks.load(**{name: getattr(args, f"{name}_network") for name in NETWORKS})
    folders = named_folders(args.model)
    pipelines = load_models(args.preset, folders)
    haired = has_deformation(args.preset, folders)
    methods = {
        name: trained(pipeline, deform=haired.get(name, True))
        for name, pipeline in pipelines.items()
    }
    if args.without_deformation:
        methods |= {
            f"{name}, no deformation": trained(pipeline, deform=False)
            for name, pipeline in pipelines.items()
            if haired.get(name, True)
        }
    tracker = Tracker.load()
    deformer = DeformationModel.from_head(tracker.head)
    bench = Bench(
        tracker,
        deformer,
        PointLayout.of(tracker.head),
        Metrics(or_absent("ST-LPIPS", partial(STLPIPS, "alex")), networks.lpips),
        methods | baselines(deformer),
        list(methods),
        or_absent("CSIM", dlib_embedder),
        args.drivers,
        frozenset(args.only or PARTS),
    )
    plan = Plan(
        args.data, args.split, args.output, args.every, args.crossings, args.runs, args.people
    )
    bald = {name for name, deform in haired.items() if not deform}
    print(evaluate(plan, bench, pipelines, bald, networks).markdown())
    print(args.output / "index.html")


def load_models(preset: str, folders: Mapping[str, Path]) -> dict[str, Preset[Any]]:
    """By the name of the method.

    Args:
        preset: of all of them.
        folders: by name; empty for the model that the preset loads.

    Raises:
        AssetError: as load_preset.
    """
    if not folders:
        return {"CVTHead" if preset == "open" else f"CVTHead, {preset}": load_preset(preset)}
    return {name: load_preset(preset, model=folder) for name, folder in folders.items()}


def has_deformation(preset: str, folders: Mapping[str, Path]) -> dict[str, bool]:
    """Whether the models of :func:`load_models` were trained with hair and shoulders."""
    if preset == "official":
        return {name: Manifest.load(folder).deformation for name, folder in folders.items()}
    return {
        name: ModelFolder.load(folder).training.get("deformation") != "false"
        for name, folder in folders.items()
    }


def named_folders(models: Sequence[str]) -> dict[str, Path]:
    """The folders of ``NAME=FOLDER`` by name.

    Raises:
        InputError: one without a name, or a name twice.
    """
    found: dict[str, Path] = {}
    for text in models:
        name, equals, folder = text.partition("=")
        if not (name and equals and folder) or name in found:
            raise InputError(
                f"--model {text} has no name of its own", hint="use NAME=FOLDER, each name once"
            )
        found[name] = Path(folder)
    return found


def or_absent(figure: str, load: Callable[[], T]) -> T | None:
    """A network, or a warning that its figure will be absent."""
    try:
        return load()
    except AssetError as error:
        # What pip says has several lines.
        reason = " ".join(str(error).split())
        warnings.warn(f"{figure} is absent: {reason}; {error.hint}", stacklevel=2)
        return None

"""A training run's configuration: a TOML file, checked completely before anything starts."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cvthead.errors import InputError
from cvthead.model.config import Features
from cvthead.official.manifest import Manifest, default_folder

ST_LPIPS = "st-lpips-alex"
SHIPPED, IMPORTED = "shipped", "imported"  # weights to start from
# What may change between two sittings of one run without changing its result.
FREE = frozenset(
    {"data", "validation", "model", "run", "init", "workers", "log_every", "save_every"}
)


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LossWeights(Section):
    """Factor of each term of the loss (paper section 3.5); 0 leaves the term out.

    ``adversarial`` and ``feature_matching`` count in stage 2 alone.
    """

    l1: float = Field(default=1.0, ge=0)
    perceptual: float = Field(default=1.0, ge=0)
    dice: float = Field(default=1.0, ge=0)
    identity: float = Field(default=0.0, ge=0)
    adversarial: float = Field(default=0.0, ge=0)
    feature_matching: float = Field(default=0.0, ge=0)


class Networks(Section):
    """Frozen networks inside the loss.

    Attributes:
        perceptual: "st-lpips-alex", or a file with a VGG-16 or VGG-19 state dict.
        identity: file with a VGGFace2 ResNet-50 state dict; None without ``losses.identity``.
    """

    perceptual: str = ST_LPIPS
    identity: Path | None = None


class Optimiser(Section):
    """Adam or AdamW.

    Attributes:
        learning_rate: peak.
        warm_up: steps until the peak.
        schedule: "constant", or "late-cosine": falls to a fiftieth over the second half.
        clip_norm: largest norm of the gradient; 0 leaves it as it is.
    """

    name: Literal["adam", "adamw"] = "adam"
    learning_rate: float = Field(default=1e-4, gt=0)
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = Field(default=0.0, ge=0)
    warm_up: int = Field(default=0, ge=0)
    schedule: Literal["constant", "late-cosine"] = "constant"
    clip_norm: float = Field(default=0.0, ge=0)


class TrainConfig(Section):
    """One run.

    Attributes:
        preset: network: "open"; "paper" on the open head; or "official", the same on FLAME.
        model: folder of the import whose head and tables "official" takes; None is the default
            one.
        features: "fused" is the preset's own network; the others are ablations, see
            cvthead.model.config. Presets "paper" and "official" have "pixel-aligned" alone.
        deformation: False trains on bald heads.
        augmentation: False leaves the pictures as they are, to learn few of them by heart;
            "official" never changes them.
        data: folder of records, such as the ``train`` folder of ``cvthead data prepare``.
        validation: folder of records of other people, such as the ``val`` folder; at every
            checkpoint the averaged weights are measured on it, and the best are kept.
        labels: CSV table (file, group) of the stills in ``data``, of which every group is then seen
            alike.
        run: folder of checkpoint and logs.
        init: checkpoint.pt of another run, a weights.safetensors, "shipped", or "imported": the
            official weights of ``model``; None starts from random weights.
        size: rendered height and width in pixels, a multiple of 32.
        steps: length of the run.
        batch: sources per step over all processes.
        stage: 2 adds the adversarial terms, as the released code's second stage does.
        precision: "bf16-mixed", "32-true", or "auto": the former where the processor computes
            in bfloat16. Elsewhere it emulates that, ten times slower than float32.
        freeze_norm: share of the steps after which batch-norm statistics stay fixed, so that the
            network is trained as it will be run; 1 never.
        average: decay of the averaged weights that are exported.
        seed: of weights and samples.
        workers: processes that load samples, for each training process; 0: that process itself.
            By default one where there are more than two cores: on two, it would take turns with
            the networks' threads, which wait for one another.
        log_every, save_every: steps between log lines and between checkpoints.
    """

    preset: Literal["open", "paper", "official"] = "open"
    model: Path | None = None
    features: Features = "fused"
    deformation: bool = True
    augmentation: bool = True
    data: Path = Path("records")
    validation: Path | None = None
    labels: Path | None = None
    run: Path = Path("run")
    init: str | None = None
    size: int = Field(default=256, ge=32, multiple_of=32)
    steps: int = Field(ge=1)
    batch: int = Field(default=16, ge=1)
    stage: Literal[1, 2] = 1
    precision: Literal["auto", "bf16-mixed", "32-true"] = "auto"
    freeze_norm: float = Field(default=1.0, ge=0, le=1)
    average: float = Field(default=0.0, ge=0, lt=1)
    seed: int = Field(default=0, ge=0)
    workers: int | None = Field(default=None, ge=0)
    log_every: int = Field(default=50, ge=1)
    save_every: int = Field(default=150, ge=1)
    losses: LossWeights = LossWeights()
    networks: Networks = Networks()
    optimiser: Optimiser = Optimiser()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.losses.identity and self.networks.identity is None:
            raise ValueError("losses.identity needs a file in networks.identity")
        if self.preset != "official":
            if self.model is not None:
                raise ValueError("model is for the preset official")
            if self.init == IMPORTED:
                raise ValueError("the imported weights are of the preset official")
        elif self.labels is not None:
            raise ValueError("the preset official learns from videos, which have no labels")
        elif self.init == IMPORTED and self.features != "fused":
            raise ValueError("the imported network has no ablation; remove init")
        if self.preset != "open" and self.features == "transformer":
            raise ValueError("the paper's network is the transformer; remove features")
        if self.stage == 2 and not self.losses.adversarial:
            raise ValueError("stage 2 needs a factor in losses.adversarial")
        return self

    @property
    def imported(self) -> Path:
        """Folder of the import that the preset official takes."""
        return self.model or default_folder()

    def fixed(self) -> dict[str, Any]:
        """What must stay the same when a run goes on, as plain values.

        Raises:
            AssetError: preset official, and nothing was imported.
        """
        official = self.preset == "official"
        tables = Manifest.load(self.imported).tables_fingerprint if official else None
        return self.model_dump(mode="json", exclude=set(FREE)) | {"tables": tables}


def load_config(name: str, given: Mapping[str, Any]) -> TrainConfig:
    """Read a configuration.

    Args:
        name: a TOML file, or the name of a shipped one.
        given: values that replace the file's; those of a section replace that key alone.

    Raises:
        InputError: no such file, not TOML, unknown keys, or wrong values.
    """
    shipped = files("cvthead.training") / "configs"
    path = Path(name)
    source = path if path.is_file() else shipped / f"{path.name.removesuffix('.toml')}.toml"
    try:
        values = tomllib.loads(source.read_text())
    except FileNotFoundError as error:
        names = sorted(p.name.removesuffix(".toml") for p in shipped.iterdir())
        raise InputError(
            f"there is no configuration {name}", hint=f"give a file, or one of {', '.join(names)}"
        ) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{name} is not TOML: {error}", hint="correct the file") from error
    try:
        return TrainConfig.model_validate(merged(values, given))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(
            f"{name}: {key + ': ' if key else ''}{first['msg']}",
            hint="docs/training.md explains the keys",
        ) from error


def merged(values: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` with those of ``given`` in their place, section by section."""
    out = dict(values)
    for key, new in given.items():
        old = out.get(key)
        both = isinstance(old, Mapping) and isinstance(new, Mapping)
        out[key] = merged(old, new) if both else new  # type: ignore[arg-type]
    return out


def setting(text: str) -> dict[str, Any]:
    """``KEY=VALUE`` as :func:`load_config` takes it; a text needs no quotes.

    Raises:
        InputError: not of this form.
    """
    key, equals, value = text.partition("=")
    for written in (value, json.dumps(value)) if equals else ():
        with suppress(tomllib.TOMLDecodeError):
            return tomllib.loads(f"{key} = {written}")
    raise InputError(f"{text!r} sets no key", hint="write KEY=VALUE, for example losses.dice=0.5")

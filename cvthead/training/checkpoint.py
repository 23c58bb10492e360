"""Everything that a run goes on from, and the weights that a run starts from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.swa_utils import AveragedModel

from cvthead import weights
from cvthead.errors import AssetError, InputError
from cvthead.official.manifest import NETWORK, Manifest
from cvthead.runtime.model_folder import WEIGHTS, packaged
from cvthead.training.config import IMPORTED, SHIPPED, TrainConfig
from cvthead.training.discriminator import MultiScaleDiscriminator

OPEN_PRESET = "open"
UNKNOWN = "unknown"  # what checkpoints of earlier versions do not tell
NOT_A_CHECKPOINT = "give a run's checkpoint.pt"
ANOTHER_NETWORK = "preset and weights must belong together"


@dataclass
class RunState:
    """What changes from step to step.

    Attributes:
        model: trained.
        averaged: its moving average, which is exported.
        optimiser: of the model.
        discriminator, discriminator_optimiser: in stage 2.
        step: steps done.
        running: smoothed losses of this process's batches.
        best: lowest ST-LPIPS on the validation records so far.
        began_with: fingerprint of the weights that the run started from, or what they were.
    """

    model: nn.Module
    averaged: AveragedModel
    optimiser: Optimizer
    discriminator: MultiScaleDiscriminator | None
    discriminator_optimiser: Optimizer | None
    step: int = 0
    running: dict[str, float] = field(default_factory=dict)
    best: float = math.inf
    began_with: str = "random weights"

    def parts(self) -> dict[str, Any]:
        """By name, those with a state_dict."""
        named = {
            "model": self.model,
            "averaged": self.averaged,
            "optimizer": self.optimiser,
            "discriminator": self.discriminator,
            "discriminator_optimizer": self.discriminator_optimiser,
        }
        return {name: part for name, part in named.items() if part is not None}


def save(path: Path, fabric: Fabric, config: TrainConfig, state: RunState) -> None:
    """Write a checkpoint, whole or not at all; every process must call this.

    It needs no random state: what a step draws depends on seed, step and process alone.
    """
    share_running(fabric, state)
    if fabric.is_global_zero:
        contents = {name: part.state_dict() for name, part in state.parts().items()}
        contents |= {
            "step": state.step,
            "running": state.running,
            "best": state.best,
            "began_with": state.began_with,
            "config": config.fixed(),
        }
        temporary = path.with_suffix(".tmp")
        torch.save(contents, temporary)
        temporary.replace(path)
    fabric.barrier()


def share_running(fabric: Fabric, state: RunState) -> None:
    """Make the smoothed losses the mean over all processes."""
    if fabric.world_size > 1:
        values = torch.tensor(list(state.running.values()), device=fabric.device)
        dist.all_reduce(values)
        means = (values / fabric.world_size).tolist()
        state.running = dict(zip(state.running, means, strict=True))


def resume(path: Path, fabric: Fabric, config: TrainConfig, state: RunState) -> None:
    """Continue from a checkpoint.

    Raises:
        InputError: not a checkpoint, or one of other settings.
    """
    contents = read(path)
    before, now = contents.get("config"), config.fixed()
    if before is None:
        raise InputError(
            f"{path} cannot be continued, it lacks its configuration",
            hint="start a new run folder from it with --init",
        )
    # A key that is newer than the checkpoint had its default's effect.
    before = TrainConfig(steps=config.steps).fixed() | before
    changed = sorted(key for key in now if before[key] != now[key])
    if changed:
        raise InputError(
            f"the run in {path.parent} was begun with other settings: {', '.join(changed)}",
            hint="choose a new run folder; --init starts from a checkpoint",
        )
    for name, part in state.parts().items():
        part.load_state_dict(contents[name])
    state.step, state.running = contents["step"], contents["running"]
    # Absent from checkpoints of earlier versions.
    state.best = contents.get("best", math.inf)
    state.began_with = contents.get("began_with", UNKNOWN)


def start_from(config: TrainConfig, state: RunState) -> None:
    """Load the weights that ``config.init`` names.

    Raises:
        InputError: not such a file, or weights of another network.
        AssetError: the imported weights are missing or altered.
    """
    assert config.init is not None
    if config.init == IMPORTED:
        path = Manifest.load(config.imported).checked(NETWORK)
    else:
        path = packaged(OPEN_PRESET) / WEIGHTS if config.init == SHIPPED else Path(config.init)
    if not path.is_file():
        raise InputError(
            f"there are no weights {path}",
            hint="give a checkpoint.pt, a weights.safetensors, `shipped`, or `imported`",
        )
    if path.suffix == ".safetensors":
        try:
            state.began_with = weights.load_into(state.model, path)
        except AssetError as error:
            raise InputError(f"{path} holds another network", hint=ANOTHER_NETWORK) from error
    else:
        contents = read(path)
        _load(state.model, contents["model"], path)
        state.began_with = weights.fingerprint(contents["model"])
        if state.discriminator is not None and "discriminator" in contents:
            state.discriminator.load_state_dict(contents["discriminator"])
    state.averaged.module.load_state_dict(state.model.state_dict())


def read(path: Path) -> dict[str, Any]:
    """A checkpoint's contents; nothing in it is run.

    Raises:
        InputError: not a checkpoint.
    """
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file stops the restricted unpickler in any way
        raise InputError(f"{path} is not a checkpoint", hint=NOT_A_CHECKPOINT) from error
    if not isinstance(contents, dict) or "model" not in contents:
        raise InputError(f"{path} is not a checkpoint", hint=NOT_A_CHECKPOINT)
    return contents


def averaged(contents: Mapping[str, Any]) -> dict[str, Tensor]:
    """The averaged weights of a checkpoint, which are exported."""
    prefix = "module."
    return {
        name.removeprefix(prefix): value
        for name, value in contents["averaged"].items()
        if name.startswith(prefix)
    }


def _load(model: nn.Module, state: dict[str, Tensor], path: Path) -> None:
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise InputError(f"{path} holds another network", hint=ANOTHER_NETWORK) from error

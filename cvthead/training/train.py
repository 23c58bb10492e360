"""The training loop: one process, or many under ``torchrun``.

A run is a folder with ``checkpoint.pt`` (continued from when present), ``best.pt`` (the checkpoint
that was best on people it does not learn from, where such are given), ``config.json``,
``log.jsonl``, ``tensorboard/`` and ``samples.png``. The samples and random numbers of a step depend
on the seed and the step alone, and the processes share each step's batch, so that neither a break
nor their number changes what is trained on.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from lightning_fabric import Fabric
from torch import Tensor, nn
from torch.optim import Adam, AdamW, Optimizer
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader, Subset

from cvthead.errors import InputError
from cvthead.files import write_errors, write_file
from cvthead.runtime.threads import cores
from cvthead.training.checkpoint import RunState, resume, save, share_running, start_from
from cvthead.training.config import TrainConfig
from cvthead.training.discriminator import MultiScaleDiscriminator, discriminator_loss
from cvthead.training.log import RunLog, sample_grid, save_picture
from cvthead.training.losses import compared_views
from cvthead.training.objective import Objective
from cvthead.training.renderers import Batch, Samples, training_parts
from cvthead.training.schedule import averaging, freeze_norms, learning_rate
from cvthead.training.validation import CHOSEN_BY, Validation

SMOOTHING = 0.98  # of the logged losses, per step
BEST = "best.pt"
BFLOAT16 = ("avx512_bf16", "amx_bf16", "bf16")  # as x86 and ARM name it
PER_VIEW = ("image", "mask", "valid", "background", "weight", "zoom")


def train(config: TrainConfig, *, sitting: int | None = None) -> Path:
    """Run a configuration, or the rest of it.

    Args:
        config: the run.
        sitting: stop after this many steps, to go on another time; None runs to the end.

    Returns:
        The checkpoint.

    Raises:
        InputError: no records, to learn from or to validate on, missing weights, a batch that the
            processes cannot share, or a run folder of other settings.
        AssetError: preset official, and nothing was imported.
    """
    fabric = launched(config)
    torch.manual_seed(config.seed)
    dataset, renderer = training_parts(config)
    objective = Objective(config).to(fabric.device)
    if half_precision(fabric, config):  # in float32 the gradients of convolutions take longer so
        renderer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    discriminator = MultiScaleDiscriminator() if config.stage == 2 else None
    # Wrapped for the distributed forward pass; the state keeps the plain networks.
    wrapped, optimiser = fabric.setup(renderer, new_optimiser(config, renderer))
    judge, judge_optimiser = None, None
    if discriminator is not None:
        plain = new_optimiser(config, discriminator)
        judge, judge_optimiser = fabric.setup(discriminator, plain)
    validation = Validation(fabric, config) if config.validation is not None else None
    state = RunState(
        renderer.model,
        AveragedModel(renderer.model, multi_avg_fn=averaging(config.average), use_buffers=True),
        optimiser,
        discriminator,
        judge_optimiser,
    )
    with write_errors(config.run):
        config.run.mkdir(parents=True, exist_ok=True)
    checkpoint = config.run / "checkpoint.pt"
    if checkpoint.exists():
        resume(checkpoint, fabric, config, state)
    elif config.init is not None:
        start_from(config, state)
    fabric.barrier()  # nobody writes before everybody has read
    first = state.step
    last = config.steps if sitting is None else min(config.steps, first + sitting)
    log = RunLog(config.run, first) if fabric.is_global_zero else None
    if fabric.is_global_zero:
        settings = config.model_dump(mode="json")
        write_file(config.run / "config.json", json.dumps(settings, indent=2).encode())
    renderer.train()
    started = time.monotonic()
    for batch in batches(fabric, config, dataset, first, last):
        if state.step >= config.freeze_norm * config.steps:
            freeze_norms(renderer)
        for each in (optimiser, judge_optimiser):
            for group in each.param_groups if each else ():
                group["lr"] = learning_rate(config.optimiser, state.step, config.steps)
        torch.manual_seed(step_seed(config.seed, state.step, fabric.global_rank))
        views = per_view(batch)
        with autocast(fabric, config):
            rgb, logits = wrapped(batch)
            losses = objective(rgb, logits, views, discriminator)
        descend(fabric, config, wrapped, optimiser, objective.total(losses))
        if judge is not None and judge_optimiser is not None:
            with autocast(fabric, config):
                shown, target = compared_views(rgb.detach(), logits.detach(), views, config.stage)
                scores = judge(torch.cat([target, shown]))
                halves = [[layer.chunk(2) for layer in scale] for scale in scores]
                real, fake = ([[h[part] for h in scale] for scale in halves] for part in (0, 1))
                losses["discriminator"] = discriminator_loss(real, fake)
            descend(fabric, config, judge, judge_optimiser, losses["discriminator"])
        state.averaged.update_parameters(renderer.model)
        state.step += 1
        for name, value in losses.items():
            now = float(value.detach())
            before = state.running.get(name, now)
            state.running[name] = before * SMOOTHING + now * (1 - SMOOTHING)
        if state.step % config.log_every == 0:
            share_running(fabric, state)
            if log is not None:
                seconds = (time.monotonic() - started) / (state.step - first)
                log.write(state.step, {"seconds_per_step": seconds} | state.running)
        if state.step % config.save_every == 0 or state.step == last:
            if validation is not None:
                mine = validation(renderer, state.averaged.module) if log is not None else {}
                found = fabric.broadcast(mine)  # or the processes might decide differently
                if log is not None:
                    log.write(state.step, found)
                if found[CHOSEN_BY] < state.best:
                    state.best = found[CHOSEN_BY]
                    save(config.run / BEST, fabric, config, state)
            save(checkpoint, fabric, config, state)
            if log is not None:
                grid = sample_grid(batch, rgb, logits)
                save_picture(config.run / "samples.png", grid)
                log.picture(state.step, grid)
    if log is not None:
        log.close()
    return checkpoint


def launched(config: TrainConfig) -> Fabric:
    """The processes of this run, as ``torchrun`` has started them; alone without it.

    Raises:
        InputError: the batch cannot be shared out evenly.
    """
    world, local = (int(os.environ.get(name, "1")) for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))
    if config.batch % world:
        raise InputError(
            f"{world} processes cannot share a batch of {config.batch} evenly",
            hint="change the batch or the number of processes",
        )
    if "OMP_NUM_THREADS" not in os.environ:  # torchrun sets it
        torch.set_num_threads(cores())
    # The ablations leave weights of the full network unused.
    ddp = "ddp" if config.features == "fused" else "ddp_find_unused_parameters_true"
    fabric = Fabric(
        devices=local,
        num_nodes=world // local,
        strategy=ddp if world > 1 else "auto",
    )
    fabric.launch()
    return fabric


def autocast(fabric: Fabric, config: TrainConfig) -> torch.autocast:
    """Half precision inside the networks, if configured.

    Fabric's own would round their inputs as well, and with them the points: in bfloat16 a point
    near the edge lies up to half a pixel off.
    """
    return torch.autocast(
        fabric.device.type, torch.bfloat16, enabled=half_precision(fabric, config)
    )


def half_precision(fabric: Fabric, config: TrainConfig) -> bool:
    """Whether the networks compute in bfloat16."""
    return config.precision == "bf16-mixed" or (
        config.precision == "auto" and computes_bfloat16(fabric.device)
    )


def computes_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions for bfloat16, rather than emulating them."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    capabilities = torch.cpu.get_capabilities()
    return any(capabilities.get(name, False) for name in BFLOAT16)


def step_seed(seed: int, step: int, rank: int) -> int:
    """Of what the network draws in a step, so that nothing needs to be remembered of it."""
    return int(np.random.SeedSequence((seed, step, rank)).generate_state(1)[0])


def new_optimiser(config: TrainConfig, network: nn.Module) -> Optimizer:
    """Adam or AdamW as configured."""
    chosen = config.optimiser
    kind = AdamW if chosen.name == "adamw" else Adam
    return kind(
        network.parameters(),
        chosen.learning_rate,
        betas=chosen.betas,
        weight_decay=chosen.weight_decay,
    )


def batches(
    fabric: Fabric, config: TrainConfig, dataset: Samples, first: int, last: int
) -> Iterator[Batch]:
    """This process's share of the samples of steps ``first`` to ``last`` - 1."""
    share = config.batch // fabric.world_size
    start = fabric.global_rank * share
    numbers = [
        step * config.batch + start + each for step in range(first, last) for each in range(share)
    ]
    workers = int(cores() > 2) if config.workers is None else config.workers
    loader = DataLoader(
        Subset(dataset, numbers),
        share,
        num_workers=workers,
        # A forked worker hangs when OpenCV had threads in this process.
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
    )
    for batch in loader:
        yield {name: value.to(fabric.device) for name, value in batch.items()}


def per_view(batch: Batch) -> dict[str, Tensor]:
    """What the losses compare with, by view."""
    views = {n: rearrange(v, "b v ... -> (b v) ...") for n, v in batch.items() if n in PER_VIEW}
    return views | {name: value for name, value in batch.items() if name == "window"}


def descend(
    fabric: Fabric, config: TrainConfig, network: nn.Module, optimiser: Optimizer, loss: Tensor
) -> None:
    """One step of an optimiser."""
    optimiser.zero_grad(set_to_none=True)
    fabric.backward(loss)
    if config.optimiser.clip_norm:
        fabric.clip_gradients(network, optimiser, max_norm=config.optimiser.clip_norm)
    optimiser.step()

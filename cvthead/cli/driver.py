"""Drivers of an animation: a video, a picture or a file of coefficients, frame by frame."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from cvthead.camera import Camera, Crop
from cvthead.cli.motion_file import read_motion
from cvthead.cli.picture import IMAGE_FORMATS
from cvthead.coefficients import Coefficients
from cvthead.controls import resolve
from cvthead.crop import head_crop
from cvthead.driving import drive
from cvthead.errors import FaceError, InputError, NoFaceError
from cvthead.images import read_image
from cvthead.preset import AnyAvatar, FaceTracker, Preset
from cvthead.tracking.one_euro import FaceFilter
from cvthead.tracking.tracker import FaceTurnedWarning, TrackedFace
from cvthead.video import probe_video, read_frames


class Step(NamedTuple):
    """``time``: seconds since the start."""

    coefficients: Coefficients
    camera: Camera
    time: float


@dataclass(frozen=True)
class Options:
    """How the driver's motion is taken over.

    Attributes:
        relative: add the motion since the driver's first frame to the portrait's own pose.
        driver_camera: let place and size of the driver's head move the result.
        smoothing: filter the tracked coefficients of a video.
    """

    relative: bool
    driver_camera: bool
    smoothing: bool


@dataclass(frozen=True)
class Drive:
    """An animation to render.

    Attributes:
        steps: what to render, in order; reading from it may raise CVTHeadError.
        count: number of steps, 0 if unknown; only an estimate for videos.
        fps: nominal frames per second.
        audio: file whose sound belongs to the animation.
    """

    steps: Iterator[Step]
    count: int
    fps: float
    audio: Path | None


def open_driver(path: Path, pipeline: Preset[Any], avatar: AnyAvatar, options: Options) -> Drive:
    """Open a driver by its ending: .json, a picture, or else a video.

    Raises:
        InputError: unreadable, or options that do not fit.
    """
    ending = path.suffix.lower()
    if ending == ".json":
        motion = read_motion(
            path, "relative" if options.relative else "absolute", camera=options.driver_camera
        )
        # All at once, so that a mistake in the last frame is found before the first is rendered.
        poses = [
            resolve(avatar.coefficients, avatar.camera, controls, pipeline.arkit)
            for controls in motion.frames
        ]
        steps = [Step(*pose, i / motion.fps) for i, pose in enumerate(poses)]
        return Drive(iter(steps), len(steps), motion.fps, None)
    if ending in IMAGE_FORMATS:
        if options.relative:
            raise InputError(
                "a single picture has no motion that could be relative",
                hint="leave out --relative, or drive with a video",
            )
        face = pipeline.tracker.track(read_image(path))
        crop = _crop(pipeline.tracker, face, options)
        pose = drive(pipeline.head, avatar, face, crop=crop)
        return Drive(iter([Step(*pose, 0.0)]), 1, 1.0, None)
    info = probe_video(path)
    audio = path if info.has_audio else None
    steps_of_video = _video_steps(path, pipeline.tracker, avatar, options)
    return Drive(steps_of_video, info.frames, info.fps, audio)


def _video_steps(
    path: Path, tracker: FaceTracker, avatar: AnyAvatar, options: Options
) -> Iterator[Step]:
    """Track frame by frame. Where the face is lost the latest pose holds; the portrait's before."""
    latest = avatar.coefficients, avatar.camera
    previous: TrackedFace | None = None
    reference: TrackedFace | None = None
    crop: Crop | None = None
    face_filter = FaceFilter()
    lost = count = 0
    for rgb, time in read_frames(path):
        count += 1
        try:
            with warnings.catch_warnings():
                # Once would be news, in every frame of a video it is noise.
                warnings.simplefilter("ignore", FaceTurnedWarning)
                previous = tracker.track(rgb, previous=previous)
        except FaceError as error:
            lost += 1
            if lost == 1:
                first_error = error
            yield Step(*latest, time)
            continue
        face = previous
        if options.smoothing:
            coefficients, camera, face_filter = face_filter.step(
                face.coefficients, face.camera, time
            )
            face = replace(face, coefficients=coefficients, camera=camera)
        if reference is None:
            reference = face
            crop = _crop(tracker, face, options)
        start = reference if options.relative else None
        latest = drive(tracker.head, avatar, face, reference=start, crop=crop)
        yield Step(*latest, time)
    if lost == count:
        raise NoFaceError(
            f"no frame of {path} shows a usable face: {first_error}", hint=first_error.hint
        )
    if lost:
        warnings.warn(
            f"no face in {lost} of {count} frames; they repeat the frame before", stacklevel=2
        )


def _crop(tracker: FaceTracker, face: TrackedFace, options: Options) -> Crop | None:
    if not options.driver_camera:
        return None
    return head_crop(tracker.head, face.coefficients, face.camera)

"""The packaged face networks, on generated images and on photos beside the repository."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cvthead.errors import ImageError
from cvthead.tracking import sessions
from cvthead.tracking.networks import BLENDSHAPE_NAMES, FaceRegion, Networks, region_of_landmarks

Image = NDArray[np.uint8]

# Nose tip, chin, forehead, outer eye corners and mouth corners (subject's right and left).
NOSE, CHIN, FOREHEAD = 1, 152, 10
RIGHT_EYE, LEFT_EYE = 33, 263
RIGHT_MOUTH, LEFT_MOUTH = 61, 291
RIGHT_IRIS, LEFT_IRIS = 468, 473


@pytest.fixture(scope="module")
def networks() -> Networks:
    return Networks.load()


@pytest.fixture(scope="module")
def photos(shared: Path) -> list[Image]:
    """Ten validation photos, far apart in the data set."""
    paths = sorted((shared / "data" / "stills" / "val").glob("*.jpg"))
    if not paths:
        pytest.skip(f"no validation stills under {shared}")
    return [read(path) for path in paths[::24]]


def read(path: Path) -> Image:
    bgr = cv2.imread(str(path))
    assert bgr is not None
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def face(networks: Networks, image: Image) -> tuple[FaceRegion, NDArray[np.float64], float]:
    """Refined region of the largest face, its landmarks and presence."""
    landmarks, _ = networks.landmarks(image, networks.detect(image)[0].region())
    region = region_of_landmarks(landmarks)
    return region, *networks.landmarks(image, region)


# Assets


def test_assets_are_the_recorded_files() -> None:
    record = sessions.network_record()
    on_disk = {path.name for path in Path(str(sessions.assets())).glob("*.onnx")}
    assert set(record) == on_disk
    for name, entry in record.items():
        contents = (sessions.assets() / name).read_bytes()
        assert hashlib.sha256(contents).hexdigest() == entry["sha256"], name


def test_conversion_is_reproducible_and_agrees_with_litert(photos: list[Image]) -> None:
    for package in ("tflite", "onnx", "ai_edge_litert"):
        pytest.importorskip(package)
    folder = os.environ.get("CVTHEAD_WHEELS")
    if not folder:
        pytest.skip("CVTHEAD_WHEELS does not name a folder with the wheels of the originals")
    from tools import convert_networks as tool
    from tools.tflite_to_onnx import convert

    pairs = {}
    for name, entry in sessions.network_record().items():
        original = tool.read_original(tool.find_wheel(entry["package"], Path(folder)), entry)
        converted = convert(original)
        assert hashlib.sha256(converted).hexdigest() == entry["sha256"], name
        pairs[name] = tool.Pair.open(original, converted)
    runs = [
        (name, *pairs[name].difference(batch))
        for image in photos
        for name, batch in tool.inputs(image, pairs)
    ]
    assert {name for name, *_ in runs} == set(pairs)
    for name, difference, output in runs:
        assert difference < tool.TOLERANCE, name
        assert output > 0, name


# Regions


@pytest.mark.parametrize("size", [40.0, 128.0, 230.0])
@pytest.mark.parametrize("angle", [0.0, 0.6, -2.0])
def test_cut_samples_where_the_map_says(size: float, angle: float) -> None:
    """On a ramp whose value is the continuous x or y less half a pixel, errors are offsets."""
    ramp = np.arange(250, dtype=np.uint8)
    x_ramp, y_ramp = np.tile(ramp, (250, 1)), np.tile(ramp[:, None], (1, 250))
    image = np.stack([x_ramp, y_ramp, y_ramp], axis=2)
    region = FaceRegion(124.3, 125.8, size, angle)
    cut = region.cut(image, 64)[..., :2].astype(float) + 0.5
    y, x = np.mgrid[:64, :64] + 0.5
    matrix = region.to_image(64)
    expected = np.stack([x, y], axis=2) @ matrix[:, :2].T + matrix[:, 2]
    inside = ((expected > 4) & (expected < 246)).all(axis=2)
    error = (cut - expected)[inside]
    assert np.abs(error.mean(axis=0)).max() < 0.1
    assert np.abs(error).max() < 1.1


def test_cut_replicates_the_border_far_outside() -> None:
    image = np.full((30, 20, 3), 90, dtype=np.uint8)
    assert (FaceRegion(-500, 900, 60, 0.3).cut(image, 32) == 90).all()
    assert (FaceRegion(10, 10, 5000, 0.3).cut(image, 32) == 90).all()


# Detection


def test_detection_finds_the_face(networks: Networks, photos: list[Image]) -> None:
    for image in photos:
        detections = networks.detect(image)
        assert detections
        left, top, right, bottom = detections[0].box
        assert 0.5 < (right - left) / (bottom - top) < 2
        assert 0.4 < detections[0].score <= 1
        eyes = detections[0].keypoints[:2]
        assert ((eyes > (left, top)) & (eyes < (right, bottom))).all()


def test_faces_come_largest_first_wherever_they_are(
    networks: Networks, photos: list[Image]
) -> None:
    small = cv2.resize(photos[0], (160, 200), interpolation=cv2.INTER_AREA)
    large = cv2.resize(photos[1], (320, 400), interpolation=cv2.INTER_AREA)
    image = np.zeros((400, 520, 3), dtype=np.uint8)
    image[100:300, 10:170], image[:, 200:] = small, large
    detections = networks.detect(image)
    assert len(detections) == 2
    assert detections[0].area > detections[1].area
    assert detections[0].box[0] > 190 > detections[1].box[0]


def test_tight_crops_are_detected(networks: Networks, photos: list[Image]) -> None:
    for image in photos:
        _, landmarks, _ = face(networks, image)
        height, width = image.shape[:2]
        low = np.clip(landmarks[:, :2].min(axis=0), 0, (width, height)).astype(int)
        high = np.clip(landmarks[:, :2].max(axis=0), 0, (width, height)).astype(int)
        tight = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
        detections = networks.detect(tight)
        assert detections
        centre = np.reshape(detections[0].box, (2, 2)).mean(axis=0)
        assert (np.abs(centre / (high - low) - 0.5) < 0.25).all()


@pytest.mark.parametrize("shape", [(64, 64), (300, 400), (700, 90), (1, 1), (2, 3000)])
def test_no_face_in_black_or_noise(networks: Networks, shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    assert networks.detect(np.zeros((*shape, 3), dtype=np.uint8)) == []
    assert networks.detect(noise) == []


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((10, 10), np.uint8),
        np.zeros((10, 10, 4), np.uint8),
        np.zeros((0, 10, 3), np.uint8),
        np.zeros((10, 10, 3), np.float32),
    ],
)
def test_other_arrays_are_refused(networks: Networks, image: Image) -> None:
    with pytest.raises(ImageError):
        networks.detect(image)
    with pytest.raises(ImageError):
        networks.landmarks(image, FaceRegion(5, 5, 5, 0))
    with pytest.raises(ImageError):
        networks.person_mask(image)


# Landmarks


def test_landmarks_lie_in_anatomical_order(networks: Networks, photos: list[Image]) -> None:
    for image in photos:
        region, landmarks, presence = face(networks, image)
        assert landmarks.shape == (478, 3)
        assert presence > 0.5
        right_to_left = np.array([np.cos(region.angle), np.sin(region.angle)])
        down = np.array([-right_to_left[1], right_to_left[0]])
        across, along = landmarks[:, :2] @ right_to_left, landmarks[:, :2] @ down
        assert across[RIGHT_EYE] < across[RIGHT_IRIS] < across[LEFT_IRIS] < across[LEFT_EYE]
        assert across[RIGHT_MOUTH] < across[LEFT_MOUTH]
        eyes = (along[RIGHT_EYE] + along[LEFT_EYE]) / 2
        assert along[FOREHEAD] < eyes < along[NOSE] < along[RIGHT_MOUTH] < along[CHIN]
        assert landmarks[NOSE, 2] < landmarks[[RIGHT_EYE, LEFT_EYE], 2].min()


def test_landmarks_follow_the_image(networks: Networks, photos: list[Image]) -> None:
    image = photos[0]
    region, landmarks, _ = face(networks, image)
    border = np.pad(image, ((30, 10), (50, 5), (0, 0)), mode="edge")
    shifted = FaceRegion(region.x + 50, region.y + 30, region.size, region.angle)
    moved, _ = networks.landmarks(border, shifted)
    assert np.abs(moved - landmarks - (50, 30, 0)).max() < 0.5


def test_landmarks_have_no_half_pixel_offset(networks: Networks, photos: list[Image]) -> None:
    """The mean x of a picture and of its mirror image add up to the picture's width."""
    offsets = []
    for image in photos:
        region, landmarks, _ = face(networks, image)
        width = image.shape[1]
        mirrored = FaceRegion(width - region.x, region.y, region.size, -region.angle)
        other, _ = networks.landmarks(np.ascontiguousarray(image[:, ::-1]), mirrored)
        total = landmarks[:, 0].mean() + other[:, 0].mean()
        offsets.append((total - width) * 256 / region.size)
    # In pixels of the network's input; counting from pixel corners would give -1.
    assert abs(float(np.mean(offsets))) < 0.5


def test_presence_is_low_without_a_face(networks: Networks) -> None:
    grey = np.full((200, 200, 3), 128, dtype=np.uint8)
    assert networks.landmarks(grey, FaceRegion(100, 100, 150, 0))[1] < 0.5


# Blendshapes and mask


def test_blendshape_names() -> None:
    assert len(BLENDSHAPE_NAMES) == len(set(BLENDSHAPE_NAMES)) == 52
    assert BLENDSHAPE_NAMES[0] == "_neutral"
    mirrored = {
        name.replace("Left", "?").replace("Right", "Left").replace("?", "Right")
        for name in BLENDSHAPE_NAMES
    }
    assert mirrored == set(BLENDSHAPE_NAMES)


def test_blendshapes_see_closed_eyes_and_open_mouth(
    networks: Networks, photos: list[Image]
) -> None:
    """Moving lids and lips of real landmarks moves the scores that are named after them."""
    _, landmarks, _ = face(networks, photos[0])
    scores = networks.blendshapes(landmarks)
    assert scores.shape == (52,)
    assert scores.min() >= 0
    assert scores.max() <= 1

    shut = landmarks.copy()
    upper, lower = (246, 161, 160, 159, 158, 157, 173), (7, 163, 144, 145, 153, 154, 155)
    shut[list(upper)] = shut[list(lower)]
    blink = [BLENDSHAPE_NAMES.index(f"eyeBlink{side}") for side in ("Right", "Left")]
    rise = networks.blendshapes(shut)[blink] - scores[blink]
    assert rise[0] > 0.2
    assert rise[0] > rise[1]


def test_blendshapes_ignore_position_and_scale(networks: Networks, photos: list[Image]) -> None:
    _, landmarks, _ = face(networks, photos[0])
    moved = networks.blendshapes(landmarks * 3 + 70)
    np.testing.assert_allclose(moved, networks.blendshapes(landmarks), atol=1e-3)


def test_mask_covers_the_face_and_not_all(networks: Networks, photos: list[Image]) -> None:
    for image in photos:
        mask = networks.person_mask(image)
        assert mask.shape == image.shape[:2]
        assert mask.dtype == np.float32
        assert mask.min() >= 0
        assert mask.max() <= 1
        _, landmarks, _ = face(networks, image)
        x, y = landmarks[[NOSE, RIGHT_MOUTH, LEFT_MOUTH], :2].astype(int).T
        assert mask[y, x].min() > 0.5
        assert mask.mean() < 0.97

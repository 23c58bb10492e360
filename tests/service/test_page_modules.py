"""The page's JavaScript modules against the Python that they must agree with."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from browser import camera_clip, chromium
from cvthead_client.wire import FROM_CLIENT, Codec, Kind, Message, pack, unpack
from playwright.sync_api import Page
from server_process import Server

from cvthead.head.arkit import ARKIT_NAMES
from cvthead.provenance import SourceType, mark_png


@pytest.fixture(scope="module")
def page(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(camera_clip(tmp_path_factory.mktemp("camera") / "clip.mjpeg")) as browser:
        opened = browser.new_page()
        opened.goto(server.url)
        yield opened


def test_sliders_cover_all_arkit_names(page: Page) -> None:
    names = page.evaluate("""async () => {
      const { GROUPS } = await import("/static/sliders.js");
      return GROUPS.flatMap(({ sliders }) => sliders.map(({ id }) => id));
    }""")
    units = [name.removeprefix("arkit.") for name in names if name.startswith("arkit.")]
    assert sorted(units) == sorted(ARKIT_NAMES)
    assert len(set(names)) == len(names)


def test_presets_name_arkit_units(page: Page) -> None:
    presets = page.evaluate("""async () => (await import("/static/sliders.js")).PRESETS""")
    assert presets
    for weights in presets.values():
        assert weights.keys() <= set(ARKIT_NAMES)
        assert all(0 <= weight <= 1 for weight in weights.values())


def test_frames_follow_the_protocol(page: Page) -> None:
    sent = page.evaluate("""async () => {
      const { pack, TYPE, CODEC } = await import("/static/wire.js");
      const payload = new Uint8Array([0xff, 0xd8, 0xff, 1, 2, 3]).buffer;
      return Array.from(new Uint8Array(pack({ type: TYPE.DRIVING, codec: CODEC.JPEG,
        sequence: 4000000000, captured: 123456.789, payload })));
    }""")
    message = unpack(bytes(sent), FROM_CLIENT)
    assert (message.kind, message.codec) == (Kind.DRIVING, Codec.JPEG)
    assert (message.sequence, message.capture_time) == (4_000_000_000, 123_456_789)
    assert message.payload == b"\xff\xd8\xff\x01\x02\x03"


def test_rendered_frames_are_understood(page: Page) -> None:
    picture = b"\xff\xd8\xff\x07"
    data = pack(Message(Kind.RENDERED, Codec.JPEG, 9, 5_000_000, picture))
    frame = page.evaluate(
        """async (bytes) => {
          const { unpack } = await import("/static/wire.js");
          const frame = unpack(new Uint8Array(bytes).buffer);
          return { ...frame, payload: Array.from(new Uint8Array(frame.payload)) };
        }""",
        list(data),
    )
    assert frame["type"] == Kind.RENDERED
    assert (frame["sequence"], frame["captured"]) == (9, 5000)
    assert bytes(frame["payload"]) == picture


@pytest.mark.parametrize("angles", [(10, 35, -20), (-60, 5, 0), (0, 0, 0), (1, -170, 80)])
def test_rotations_compose_yaw_pitch_roll(page: Page, angles: tuple[float, float, float]) -> None:
    axis_angle, back = page.evaluate(
        """async (angles) => {
          const { toAxisAngle, toDegrees } = await import("/static/rotation.js");
          return [toAxisAngle(angles), toDegrees(toAxisAngle(angles))];
        }""",
        list(angles),
    )
    x, y, z = (cv2.Rodrigues(turn)[0] for turn in np.diag(np.deg2rad(angles)))
    np.testing.assert_allclose(cv2.Rodrigues(np.array(axis_angle, float))[0], y @ x @ z, atol=1e-6)
    np.testing.assert_allclose(back, angles, atol=1e-6)


def test_pages_mark_is_that_of_the_service(page: Page) -> None:
    plain = cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes()
    marked = page.evaluate(
        """async ([bytes, source]) => {
          const { markPng } = await import("/static/mark.js");
          const blob = await markPng(new Blob([new Uint8Array(bytes)]), source);
          return Array.from(new Uint8Array(await blob.arrayBuffer()));
        }""",
        [list(plain), str(SourceType.GENERATED)],
    )
    assert bytes(marked) == mark_png(plain, SourceType.GENERATED)

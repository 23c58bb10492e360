"""The Python client against a real server, from the upload to the deletion, both ways."""

from __future__ import annotations

import asyncio
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from cvthead_client import (
    AsyncClient,
    Camera,
    Client,
    CoefficientFrame,
    Controls,
    Hello,
    Output,
    Retry,
    StreamOutput,
    errors,
)
from PIL import Image
from raw_stream import jpeg, noise, pixels
from server_process import PORTRAIT, Server, start_server

from cvthead.provenance import SourceType, read_mark

JAW = Controls(jaw=(0.3, 0, 0))
NEUTRAL = CoefficientFrame(np.zeros(50, np.float32), np.zeros(15, np.float32))


@pytest.fixture(scope="module")
def sdk(server: Server) -> Iterator[Client]:
    with Client(server.url) as client:
        yield client


@pytest.fixture(scope="module")
def uploaded(sdk: Client) -> str:
    return sdk.create(PORTRAIT).id


def test_from_upload_to_deletion(sdk: Client, tmp_path: Path) -> None:
    made = sdk.create(PORTRAIT.read_bytes(), lifetime=3600, consent=True)
    assert made.expires is not None
    assert abs((made.expires - made.created).total_seconds() - 3600) < 1
    assert made.face_box is not None
    assert made.source is not None
    assert len(made.source.pose.flat()) == 15
    assert sdk.get(made.id) == made

    opened = sdk.render(made.id, JAW)
    assert opened.media_type == "image/png"
    assert opened.source_type == SourceType.GENERATED
    assert {"queue", "pose", "paint", "encode"} <= opened.timings.keys()
    assert opened.request_id
    opened.save(tmp_path / "frame.png")
    assert read_mark((tmp_path / "frame.png").read_bytes()) == SourceType.GENERATED
    assert np.abs(pixels(opened.data) - pixels(sdk.preview(made.id).data)).mean() > 0.5

    sdk.delete(made.id)
    for use in (sdk.get, sdk.render, sdk.delete, sdk.preview):
        with pytest.raises(errors.AvatarNotFoundError):
            use(made.id)


def test_every_control_reaches_the_service(sdk: Client, uploaded: str) -> None:
    """Each alone changes the picture."""
    portrait = pixels(sdk.render(uploaded).data)
    turn = (0.0, 0.25, 0.0)
    for controls in (
        Controls(shape=np.full(100, 1.0)),  # type: ignore[arg-type]
        Controls(expression=[2.0] * 50),
        Controls(global_rotation=turn),
        Controls(neck=turn),
        Controls(jaw=(0.3, 0, 0)),
        Controls(left_eye=turn),
        Controls(right_eye=turn),
        Controls(arkit={"jawOpen": 1.0}),
        Controls(arkit={}),  # the neutral expression
        Controls(camera=Camera(4.0, 0.0, 0.0)),
        Controls(expression=[1.0] * 50, mode="relative"),
    ):
        assert np.any(pixels(sdk.render(uploaded, controls).data) != portrait), controls


def test_output_and_format(sdk: Client, uploaded: str) -> None:
    output = Output(size=64, background="#ff0000", quality=100)
    picture = sdk.render(uploaded, output=output, picture_format="jpeg")
    assert picture.media_type == "image/jpeg"
    with Image.open(BytesIO(picture.data)) as image:
        assert image.size == (64, 64)
        red, green, blue = image.convert("RGB").getpixel((1, 1))  # type: ignore[misc]
    assert red > 200
    assert green < 60
    assert blue < 60
    assert sdk.preview(uploaded, picture_format="webp").media_type == "image/webp"


def test_drive_and_track(sdk: Client, uploaded: str) -> None:
    with Image.open(PORTRAIT) as portrait:
        tilted = jpeg(portrait.rotate(15, fillcolor="white"))
    tracked = sdk.track(tilted)
    assert len(tracked.arkit) > 50
    assert sdk.track(tilted, blendshapes=False).arkit == {}
    driven = pixels(sdk.drive(uploaded, tilted).data)
    rendered = sdk.render(uploaded, tracked.controls(), output=Output(background="white"))
    # Both show the driver's face; a driver turns the head, controls the whole body.
    follows = sdk.drive(uploaded, tilted, output=Output(background="white"))
    for picture in (rendered, follows):
        roll = sdk.track(picture.data).pose.global_rotation[2]
        assert roll == pytest.approx(tracked.pose.global_rotation[2], abs=0.08)
    # No motion since the reference leaves the portrait as it is, but for points whose rounding puts
    # them into the next pixel: a grey level here and there.
    still = pixels(sdk.drive(uploaded, tilted, reference=tilted, camera="driver").data)
    portrait_itself = pixels(sdk.preview(uploaded).data)
    change = [np.abs(picture - portrait_itself).mean() for picture in (still, driven)]
    assert change[0] < 0.2
    assert change[1] > 3


def test_batch(sdk: Client, uploaded: str, tmp_path: Path) -> None:
    frames = [Controls(jaw=(0.1 * number, 0, 0)) for number in range(3)]
    pictures = list(sdk.batch(uploaded, frames, output=Output(size=64), picture_format="webp"))
    assert [picture.media_type for picture in pictures] == ["image/webp"] * 3
    assert len({picture.data for picture in pictures}) == 3
    sdk.batch_file(uploaded, frames, tmp_path / "frames.zip")
    with zipfile.ZipFile(tmp_path / "frames.zip") as archive:
        assert len(archive.namelist()) == 3
    sdk.batch_file(uploaded, frames, tmp_path / "frames.mp4", fps=10)
    assert read_mark((tmp_path / "frames.mp4").read_bytes()) == SourceType.GENERATED
    with pytest.raises(errors.CVTHeadClientError):
        sdk.batch_file(uploaded, frames, tmp_path / "frames.gif")
    with pytest.raises(errors.AvatarNotFoundError):
        sdk.batch_file("0" * 32, frames, tmp_path / "nothing.zip")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames.mp4", "frames.zip"]


def test_list_goes_through_all_pages(sdk: Client) -> None:
    made = [sdk.create(PORTRAIT).id for _ in range(3)]
    listed = [info.id for info in sdk.list(page_size=2)]
    assert listed[:3] == made[::-1]
    assert len(set(listed)) == len(listed)
    for identifier in made:
        sdk.delete(identifier)


def test_same_idempotency_key_gives_the_same_avatar(sdk: Client) -> None:
    first = sdk.create(PORTRAIT, idempotency_key="once")
    assert sdk.create(PORTRAIT, idempotency_key="once").id == first.id
    with pytest.raises(errors.IdempotencyError):
        sdk.create(PORTRAIT, lifetime=100, idempotency_key="once")


def test_stream(sdk: Client, uploaded: str) -> None:
    hello = Hello(StreamOutput("png"), window=1)
    with sdk.stream(uploaded, hello) as stream:
        assert stream.welcome.avatar == uploaded
        for _ in range(3):  # each is acknowledged, or the window would hold the next one back
            sequence = stream.send_coefficients(NEUTRAL, capture_time=17)
            reply = next(iter(stream))
            assert (reply.sequence, reply.capture_time) == (sequence, 17)
        sequence = stream.send_picture(PORTRAIT.read_bytes(), reference=True)
        assert next(iter(stream)).sequence == sequence
        stream.send_picture(noise())
        while stream.stats.lost_face == 0:
            stream.receive(60)
        assert stream.stats.rendered == 4
        with pytest.raises(errors.RequestTimeoutError):  # nothing but counts, and they end
            [stream.receive(2.5) for _ in range(10)]
        with pytest.raises(errors.WireError):
            stream.send_picture(b"not a picture")
    with pytest.raises(errors.StreamClosedError) as raised:
        stream.receive()
    assert raised.value.close_code == 1000
    assert list(stream) == []


def test_stream_says_why_it_ended(sdk: Client) -> None:
    identifier = sdk.create(PORTRAIT).id
    with sdk.stream(identifier) as stream:
        sdk.delete(identifier)
        with pytest.raises(errors.AvatarNotFoundError):
            list(stream)
        # The close frame may still be on its way.
        with pytest.raises((errors.AvatarNotFoundError, errors.StreamClosedError)):
            [stream.send_coefficients(NEUTRAL) for _ in range(100_000)]
    with pytest.raises(errors.AvatarNotFoundError) as raised, sdk.stream(identifier):
        pass
    assert raised.value.hint


def test_damaged_driving_frame(sdk: Client, uploaded: str) -> None:
    with sdk.stream(uploaded) as stream:
        stream.send_picture(noise(64)[:200])
        with pytest.raises(errors.InvalidImageError):
            stream.receive(60)


def test_refusals_a_caller_can_act_on(sdk: Client, uploaded: str) -> None:
    with Image.open(PORTRAIT) as portrait:
        head = portrait.convert("RGB").crop((100, 0, 350, 250))
        pair = Image.new("RGB", (500, 250))
        pair.paste(head, (0, 0))
        pair.paste(head, (250, 0))
        small = portrait.resize((96, 96))
    with pytest.raises(errors.NoFaceError):
        sdk.create(noise())
    with pytest.raises(errors.SeveralFacesError) as several:
        sdk.create(jpeg(pair))
    assert len(several.value.boxes) == 2
    sdk.delete(sdk.create(jpeg(pair), face=1).id)
    with pytest.raises(errors.FaceTooSmallError):
        sdk.create(jpeg(small))
    with pytest.raises(errors.InvalidImageError) as kind:
        sdk.create(b"GIF89a nonsense")
    assert kind.value.code == "unsupported_media_type"
    with pytest.raises(errors.InvalidImageError):
        sdk.create(noise(64)[:200])
    with pytest.raises(errors.TooLargeError):
        sdk.create(PORTRAIT.read_bytes() + bytes(21_000_000))
    with pytest.raises(errors.InvalidRequestError) as invalid:
        sdk.render(uploaded, Controls(expression=[0.0] * 49))
    assert invalid.value.errors[0]["pointer"].startswith("/expression")
    with pytest.raises(errors.InvalidRequestError):
        sdk.render(uploaded, Controls(arkit={"noSuchName": 1.0}))
    with pytest.raises(errors.InvalidCoefficientsError):  # only the sum is out of range
        sdk.render(uploaded, Controls(expression=[50.0] * 50, mode="relative"))


def test_expired_avatar(sdk: Client) -> None:
    identifier = sdk.create(PORTRAIT, lifetime=1).id

    async def later() -> None:
        async with AsyncClient(sdk.server) as client:
            await asyncio.sleep(1.5)
            with pytest.raises(errors.AvatarExpiredError):
                await client.render(identifier)
            with pytest.raises(errors.AvatarExpiredError):
                async with client.stream(identifier):
                    pass

    asyncio.run(later())


def test_asynchronous_client(server: Server, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with AsyncClient(server.url) as client:
            made = await client.create(PORTRAIT)
            assert await client.get(made.id) == made
            assert made.id in [info.id async for info in client.list(page_size=2)]
            pictures = await asyncio.gather(*(client.render(made.id, JAW) for _ in range(3)))
            assert len({picture.data for picture in pictures}) == 1
            assert (await client.preview(made.id)).media_type == "image/png"
            assert (await client.drive(made.id, PORTRAIT)).media_type == "image/png"
            assert (await client.track(PORTRAIT)).presence > 0.5
            assert len([p async for p in client.batch(made.id, [JAW, Controls()])]) == 2
            await client.batch_file(made.id, [JAW], tmp_path / "one.zip")
            assert zipfile.is_zipfile(tmp_path / "one.zip")
            async with client.stream(made.id) as stream:
                await stream.send_coefficients(NEUTRAL)
                await stream.send_picture(PORTRAIT.read_bytes())
                shown = [await anext(aiter(stream)), await anext(aiter(stream))]
                assert [frame.sequence for frame in shown] == [0, 1]
                await client.delete(made.id)
                with pytest.raises(errors.AvatarNotFoundError):
                    async for _ in stream:
                        pass
            with pytest.raises(errors.AvatarNotFoundError):
                await client.get(made.id)

    asyncio.run(scenario())


def test_keys_consent_limits_and_a_full_store(tmp_path: Path) -> None:
    key = "key-of-ann-0123456789"
    with (
        start_server(tmp_path, keys=f"ann:{key}", rate_limit=8, store_max_avatars=1) as server,
        Client(server.url, key=key, retry=Retry(attempts=0)) as client,
    ):
        with Client(server.url, key="wrong") as stranger:
            with pytest.raises(errors.UnauthorizedError):
                stranger.get("0" * 32)
            with pytest.raises(errors.UnauthorizedError), stranger.stream("0" * 32):
                pass
        with pytest.raises(errors.ConsentRequiredError):
            client.create(PORTRAIT)
        made = client.create(PORTRAIT, consent=True)
        with pytest.raises(errors.StoreFullError):
            client.create(PORTRAIT, consent=True)
        with client.stream(made.id) as stream:
            server.terminate()
            with pytest.raises(errors.UnavailableError):
                for _ in stream:
                    pass


def test_rate_limit(tmp_path: Path) -> None:
    with start_server(tmp_path, rate_limit=2) as server, Client(server.url) as client:
        for _ in range(2):
            with pytest.raises(errors.AvatarNotFoundError):
                client.get("0" * 32)
        with pytest.raises(errors.RateLimitedError) as raised:
            client.get("0" * 32)
        assert raised.value.retry_after
        with pytest.raises(errors.RateLimitedError), client.stream("0" * 32):
            pass


def test_foreign_host(server: Server) -> None:
    # A name that resolves to the service but is not its own, as in DNS rebinding.
    url = server.url.replace("127.0.0.1", "127.1")
    with Client(url) as client:
        with pytest.raises(errors.ForbiddenError):
            client.get("0" * 32)
        with pytest.raises(errors.ForbiddenError), client.stream("0" * 32):
            pass


def test_not_a_cvthead_service(server: Server) -> None:
    with Client(f"{server.url}/docs") as client, pytest.raises(errors.InvalidRequestError):
        client.get("0" * 32)

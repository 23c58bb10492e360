"""The page in headless Chromium against a real server: portrait, sliders, webcam, keys."""

from __future__ import annotations

import itertools
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from browser import camera_clip, chromium, pixels
from playwright.sync_api import Browser, ConsoleMessage, Page, ViewportSize, expect
from server_process import PORTRAIT, Server, start_server

from cvthead.provenance import SourceType, read_mark

# Everything is slow on a busy machine; a test that fails waits this long.
PATIENCE = 90_000
PHONE = ViewportSize(width=390, height=844)
DESKTOP = ViewportSize(width=1280, height=860)
KEY = "alice-0123456789abcdef"
MARKS = {str(kind) for kind in SourceType}


@dataclass
class Visit:
    """The page in a browser, and what its console said."""

    page: Page
    errors: list[str] = field(default_factory=list)

    def open(self, url: str) -> None:
        self.page.set_default_timeout(PATIENCE)
        self.page.on("console", self._listen)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url)

    def _listen(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.errors.append(message.text)

    def take_sample(self) -> None:
        """One click on the sample portrait, until it is there."""
        self.page.get_by_role("button", name="Try the sample portrait").click()
        expect(self.page.locator("#picture")).to_be_visible(timeout=PATIENCE)

    def open_group(self, title: str) -> None:
        self.page.locator("summary", has_text=title).first.click()

    def change(self, slider: str, value: str) -> None:
        """Move a slider, wait for another picture."""
        before = self.source()
        self.page.get_by_label(slider, exact=True).first.fill(value)
        self.another(before)

    def source(self) -> str:
        return self.page.locator("#picture").get_attribute("src") or ""

    def another(self, before: str) -> None:
        picture = self.page.locator("#picture")
        expect(picture).not_to_have_attribute("src", before, timeout=PATIENCE)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(camera_clip(tmp_path_factory.mktemp("camera") / "clip.mjpeg")) as running:
        yield running


@pytest.fixture
def visit(browser: Browser, server: Server) -> Iterator[Visit]:
    """The page of the common server; fails when the browser's console showed an error."""
    context = browser.new_context(viewport=DESKTOP, accept_downloads=True)
    opened = Visit(context.new_page())
    opened.open(server.url)
    yield opened
    context.close()
    assert not opened.errors


def test_policy_allows_only_own_files(client: httpx.Client) -> None:
    answer = client.get("/")
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\ssrc=)", answer.text)
    addresses = re.findall(r'(?:src|href)="([^"#]+)"', answer.text)
    assert addresses
    assert all(address.startswith("/") for address in addresses)
    assert all(client.get(address).status_code == 200 for address in addresses)


def test_static_files_only_from_their_folder(client: httpx.Client) -> None:
    assert client.get("/static/none.js").status_code == 404
    assert client.get("/static/..%2fsettings.py").status_code == 404
    first = client.get("/static/main.js")
    again = client.get("/static/main.js", headers={"If-None-Match": first.headers["ETag"]})
    assert again.status_code == 304


def test_slider_changes_the_picture(visit: Visit) -> None:
    visit.take_sample()
    before = pixels(visit.page)
    visit.change("Turn", "35")
    turned = pixels(visit.page)
    assert np.abs(turned - before).mean() > 4
    visit.page.get_by_role("button", name="Reset all").click()
    expect(visit.page.locator(".slider.moved")).to_have_count(0)
    visit.page.wait_for_timeout(1000)
    assert np.abs(pixels(visit.page) - before).mean() < 1


def test_left_and_right_move_together(visit: Visit) -> None:
    visit.take_sample()
    visit.open_group("Mouth")
    visit.change("Smile left", "0.8")
    json = visit.page.locator("#json")
    expect(json).to_contain_text('"mouthSmileRight": 0.8')
    visit.page.get_by_label("Left and right together").uncheck()
    visit.change("Smile left", "0.3")
    expect(json).to_contain_text('"mouthSmileLeft": 0.3')
    expect(json).to_contain_text('"mouthSmileRight": 0.8')


def test_absolute_mode_keeps_the_picture(visit: Visit) -> None:
    visit.take_sample()
    visit.change("Turn", "20")
    visit.open_group("Head shape")
    visit.change("Shape 1", "2")
    before, address = pixels(visit.page), visit.source()
    visit.page.get_by_label("Values").select_option("absolute")
    visit.another(address)
    expect(visit.page.locator("#json")).to_contain_text('"mode": "absolute"')
    assert np.abs(pixels(visit.page) - before).mean() < 2


def test_curl_line_works_as_pasted(visit: Visit, tmp_path: Path) -> None:
    visit.take_sample()
    visit.change("Nod", "-15")
    visit.open_group("Request")
    line = visit.page.locator("#curl").inner_text()
    subprocess.run(["bash", "-c", line], cwd=tmp_path, check=True, timeout=120)
    data = (tmp_path / "frame.png").read_bytes()
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape == (256, 256, 4)


def test_download_is_marked(visit: Visit, tmp_path: Path) -> None:
    visit.take_sample()
    assert _downloaded(visit, tmp_path / "render.png") in MARKS


def test_webcam_renders_moving_frames(visit: Visit, client: httpx.Client, tmp_path: Path) -> None:
    visit.take_sample()
    visit.page.get_by_role("button", name="Webcam").click()
    seen = []
    address = visit.source()
    for _ in range(8):
        visit.another(address)
        address = visit.source()
        seen.append(pixels(visit.page))
    changes = [np.abs(b - a).mean() for a, b in itertools.pairwise(seen)]
    assert max(changes) > 2, changes
    number = re.compile(r"^[1-9]|^0\.[1-9]")
    expect(visit.page.locator("#stat-fps")).to_have_text(number, timeout=PATIENCE)
    expect(visit.page.locator("#stat-latency")).to_have_text(number)
    assert visit.page.locator("#stat-dropped").inner_text().isdecimal()
    # A frame of the stream is written as PNG by the page, which adds the mark.
    assert _downloaded(visit, tmp_path / "frame.png") in MARKS

    visit.page.get_by_role("button", name="Sliders").click()
    expect(visit.page.locator("#camera-view")).to_be_hidden()
    visit.page.wait_for_timeout(1000)
    assert "cvthead_streams 0.0" in client.get("/metrics").text


def test_consent_comes_before_upload(visit: Visit) -> None:
    page = visit.page
    uploads = []
    page.on("request", lambda r: uploads.append(r.url) if r.method == "POST" else None)
    page.locator("#file").set_input_files(str(PORTRAIT))
    expect(page.locator(".consent.wanted")).to_be_visible()
    page.wait_for_timeout(300)
    assert not uploads
    page.get_by_label("The person in this picture agreed").check()
    expect(page.locator("#picture")).to_be_visible(timeout=PATIENCE)
    assert "consent=true" in uploads[0]


def test_problem_is_shown_with_its_hint(visit: Visit, tmp_path: Path) -> None:
    wall = tmp_path / "wall.png"
    cv2.imwrite(str(wall), np.full((300, 300, 3), 128, np.uint8))
    visit.page.get_by_label("The person in this picture agreed").check()
    visit.page.locator("#file").set_input_files(str(wall))
    alert = visit.page.get_by_role("alert")
    expect(alert).to_be_visible(timeout=PATIENCE)
    assert visit.page.locator("#alert-detail").inner_text()
    assert visit.page.locator("#alert-hint").inner_text()
    # The browser itself writes failed requests to the console.
    assert all("422" in error for error in visit.errors)
    visit.errors.clear()
    visit.take_sample()
    expect(alert).to_be_hidden()


def test_one_of_several_faces_is_chosen(visit: Visit, tmp_path: Path) -> None:
    portrait = cv2.imread(str(PORTRAIT))
    assert portrait is not None
    couple = tmp_path / "couple.png"
    head = portrait[:300, 90:360]
    cv2.imwrite(str(couple), np.hstack([head, head[:, ::-1]]))
    visit.page.get_by_label("The person in this picture agreed").check()
    visit.page.locator("#file").set_input_files(str(couple))
    faces = visit.page.get_by_role("button", name="Use face")
    expect(faces).to_have_count(2, timeout=PATIENCE)
    visit.errors.clear()  # the browser writes the 422 to the console
    faces.last.click()
    expect(visit.page.locator("#picture")).to_be_visible(timeout=PATIENCE)
    expect(visit.page.get_by_role("alert")).to_be_hidden()


def test_delete_removes_the_avatar(visit: Visit, client: httpx.Client) -> None:
    created = []
    visit.page.on("response", lambda r: created.append(r) if r.status == 201 else None)
    visit.take_sample()
    avatar = created[0].json()["id"]
    visit.page.get_by_role("button", name="Delete avatar").click()
    expect(visit.page.locator("#start")).to_be_visible()
    assert client.get(f"/v1/avatars/{avatar}").status_code == 404


def test_phone_and_keyboard(browser: Browser, server: Server) -> None:
    context = browser.new_context(viewport=PHONE, has_touch=True, color_scheme="dark")
    visit = Visit(context.new_page())
    visit.open(server.url)
    page = visit.page
    for _ in range(8):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.id") == "sample":
            break
    page.keyboard.press("Enter")
    expect(page.locator("#picture")).to_be_visible(timeout=PATIENCE)
    address = visit.source()
    page.get_by_label("Turn", exact=True).first.focus()
    page.keyboard.press("End")
    visit.another(address)
    # Nothing sticks out to the right, and the picture stays in sight beside the last slider.
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.locator("#request-card").scroll_into_view_if_needed()
    expect(page.locator("#picture")).to_be_in_viewport()
    context.close()
    assert not visit.errors


def test_key_stays_in_memory(browser: Browser, tmp_path: Path) -> None:
    with start_server(tmp_path, keys=f"alice:{KEY}") as server:
        context = browser.new_context(viewport=DESKTOP)
        visit = Visit(context.new_page())
        addresses: list[str] = []
        visit.page.on("request", lambda request: addresses.append(request.url))
        visit.page.on("websocket", lambda socket: addresses.append(socket.url))
        visit.open(server.url)
        visit.page.get_by_role("button", name="Try the sample portrait").click()
        field_of_key = visit.page.get_by_label("Key of this server")
        expect(field_of_key).to_be_focused(timeout=PATIENCE)
        visit.errors.clear()  # the browser writes the 401 to the console
        field_of_key.fill(KEY)
        field_of_key.press("Enter")
        visit.take_sample()
        visit.page.get_by_role("button", name="Webcam").click()
        visit.another(visit.source())
        assert any(address.startswith("ws") and "ticket=" in address for address in addresses)
        assert not any(KEY in address for address in addresses)
        stored = "JSON.stringify([document.cookie, {...localStorage}, {...sessionStorage}])"
        assert KEY not in visit.page.evaluate(stored)
        assert KEY not in visit.page.content()
        context.close()
        assert not visit.errors


def _downloaded(visit: Visit, path: Path) -> str | None:
    """The mark in the file that the download button gives."""
    with visit.page.expect_download() as download:
        visit.page.get_by_role("button", name="Download PNG").click()
    download.value.save_as(path)
    data = path.read_bytes()
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) is not None
    return read_mark(data)

"""The live page in a real browser: clicks, pictures, and browsers that come and go. Nothing here depends on speed."""

from __future__ import annotations

import io
import threading
import time

import numpy as np
import pytest

from palpate import weigh
from palpate.errors import InputError
from palpate.logs import Log
from palpate.studies._browser import PHONE, browser, dismiss, find_browser, opened, pictures

pytest.importorskip("viser", reason="the page needs the extra view")
pytest.importorskip("playwright", reason="the browser is driven by playwright")
pytestmark = [
    pytest.mark.skipif(find_browser() is None, reason="no Chromium on this machine"),
    pytest.mark.timeout(1200),
]

from palpate.view import Page, Recording, ShownArm, SimulatedArm, Source  # noqa: E402
from palpate.view.scene import Badge, Channels  # noqa: E402

WINDOW = (900, 560)
"""small, for the processor draws it"""
LONG_S = 240.0


def until(what):
    """Wait until `what` is true: long, because the machine may be busy and the browser's pictures are drawn on it."""
    deadline = time.monotonic() + LONG_S
    while not what():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


class Shown:
    """A page that is kept up to date by a thread, and its browser's complaints."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.page = Page(source, port=0)
        source.start()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self.page.run, args=(self._over.is_set, 10.0), daemon=True)
        self._thread.start()
        self.complaints: list[str] = []

    def open(self, found, size):
        things = sum(len(shown.arm.solid_shapes()) for shown in self.source.arms)
        page = opened(found, self.page.url, size, things, LONG_S)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self._asked(request.url))
        dismiss(page)
        return page

    def _asked(self, url):
        if not url.startswith((self.page.url, "blob:", "data:", self.page.url.replace("http", "ws"))):
            self.complaints.append(f"asked for {url}")

    def close(self):
        self._over.set()
        self._thread.join()
        self.source.stop()
        self.page.close()


def simulated(tmp_path, rate=1000.0):
    scene = weigh.scene(weigh.load_arm("justina_left_arm"))
    task = weigh.Task(scene=scene, start=scene.poses["Zero"], poses=(scene.poses["Take3"],), rate=rate)
    source = SimulatedArm(weigh.simulated_driver(task), scene, out=tmp_path, mass=0.25)
    source.send("Take3")
    return source


def colours(page) -> int:
    """How many different colours are in the middle of the picture."""
    from PIL import Image

    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    height, width = picture.shape[:2]
    box = page.locator("canvas").first.bounding_box()
    left, right = int(box["x"]), min(int(box["x"] + box["width"]), width)
    middle = picture[: height // 2, left:right].reshape(-1, 3)
    return len(np.unique(middle // 16, axis=0))


def field(page, label):
    """What one can type into beside a label."""
    row = page.locator(f"label:text-is('{label}')").locator(
        "xpath=ancestor::*[.//input[not(@type='hidden')]][1]"
    )
    return row.locator("input:not([type=hidden])").first


def set_value(page, label, value):
    """Type a value and finish with Enter."""
    field(page, label).fill(str(value))
    field(page, label).press("Enter")


def test_a_person_uses_the_page_and_returns_by_phone(tmp_path):
    shown = Shown(simulated(tmp_path))
    source = shown.source
    try:
        with browser() as found:
            page = shown.open(found, WINDOW)
            page.get_by_text("good").first.wait_for()
            page.get_by_text("really held").wait_for()
            assert colours(page) > 8, "an arm is in the picture"
            assert pictures(page) > 0

            page.get_by_role("button", name="Stop here").click()
            page.get_by_text("StandBy2", exact=True).click()
            goal = source.arms[0].poses["StandBy2"]
            until(lambda: np.allclose(source.reading(0).goal, goal, atol=1e-6))

            page.get_by_role("button", name="Tare").click()
            page.get_by_text("tared by").or_(page.get_by_text("Only a good mass")).first.wait_for()
            dismiss(page)

            set_value(page, "mass [kg]", 0.4)
            until(lambda: source.held(0) == 0.4)

            page.get_by_text("Push (simulated)").click()
            set_value(page, "force [N]", 4)
            until(lambda: bool(np.any(source._plant.data.xfrc_applied)))
            page.get_by_role("button", name="Let go").click()
            until(lambda: not np.any(source._plant.data.xfrc_applied))

            page.get_by_role("button", name="Record").click()
            until(lambda: source.recording is not None)
            path = source.recording
            page.get_by_role("button", name="Stop recording").click()
            until(lambda: source.recording is None)
            assert len(Log.open(path)) > 0
            dismiss(page)

            page.get_by_text("Estimators", exact=True).click()
            set_value(page, "min change", 0.02)
            page.get_by_role("button", name="Use these").click()
            until(lambda: source.options(0)["payload"]["min_change"] == 0.02)
            dismiss(page)

            field = (
                page.locator("label:text-is('angles [rad]')")
                .locator("xpath=ancestor::*[.//input][1]")
                .locator("input")
            )
            field.fill("1, 2")
            field.press("Enter")
            page.get_by_role("button", name="Go to these angles").click()
            page.get_by_text("has 7 joints, got 2 angles").wait_for()
            page.screenshot(path=tmp_path / "desktop.png")
            page.close()

            frames, time_s = shown.page.frames, source.reading(0).time  # nobody looks, and it goes on
            until(lambda: shown.page.frames > frames + 5 and source.reading(0).time > time_s + 0.1)

            page = shown.open(found, PHONE)
            width = page.get_by_role("button", name="Stop here").bounding_box()["width"]
            assert width > 0.8 * PHONE[0], "the controls are as wide as the phone"
            assert page.evaluate("document.documentElement.scrollWidth") <= PHONE[0]
            page.get_by_text("Take2", exact=True).click()
            goal = source.arms[0].poses["Take2"]
            until(lambda: np.allclose(source.reading(0).goal, goal, atol=1e-6))
            page.screenshot(path=tmp_path / "phone.png")
            assert colours(page) > 8, "the arm is above the controls"
        assert not shown.complaints
    finally:
        shown.close()


@pytest.mark.slow
def test_a_recording_is_played_in_the_browser(tmp_path):
    scene = weigh.scene(weigh.load_arm("justina_left_arm"))
    plan = weigh.Task(
        scene=scene,
        start=scene.poses["Zero"],
        poses=(scene.poses["Take3"],),
        loads=((0.0, 0.25),),
        duration=4.0,
    )
    weigh.run(plan, weigh.make_pipeline(scene.arm)[0], record=tmp_path / "run.mcap")
    shown = Shown(Recording(Log.open(tmp_path / "run.mcap", keep_invalid=True)))
    try:
        with browser() as found:
            page = shown.open(found, WINDOW)
            set_value(page, "time [s]", 2.0)
            page.get_by_role("button", name="Pause").or_(
                page.get_by_role("button", name="Play")
            ).first.wait_for()
            until(lambda: not shown.source.playing)
            set_value(page, "time [s]", 1.0)
            until(lambda: shown.source.position < 4.0)
            page.get_by_text("20", exact=True).last.click()
            until(lambda: not shown.source.playing)
            page.get_by_text("4.0 of 4.0 s").wait_for()
            page.get_by_role("button", name="Play").wait_for()
        assert not shown.complaints
    finally:
        shown.close()


class Pair(Source):
    """Two arms and a camera, standing still."""

    def __init__(self, reading, arm):
        left, right = np.eye(4), np.eye(4)
        right[1, 3] = -0.5
        self._arms = (
            ShownArm("master <b>", arm, T_world_base=left),
            ShownArm("slave", arm, T_world_base=right),
        )
        self._reading = reading
        self._picture = np.zeros((24, 32, 3), dtype=np.uint8)

    @property
    def arms(self):
        return self._arms

    def start(self):
        pass

    def stop(self):
        pass

    def reading(self, arm):
        return self._reading if arm == 0 else None

    def curves(self, arm, span):
        return np.empty(0), np.empty((0, Channels(7).count))

    @property
    def state(self):
        return Badge("still", "grey")

    def images(self):
        return {"camera": self._picture}


def test_a_page_of_two_arms_and_a_camera_made_by_another_program(tmp_path):
    lifting = simulated(tmp_path, 250.0)
    lifting.connect()
    reading = [lifting.tick() for _ in range(500)][-1]
    shown = Shown(Pair(reading, lifting.arms[0].arm))
    lifting.stop()
    try:
        until(lambda: shown.page.frames > 5)
        server = shown.page._server
        sent = [type(m).__name__ for m in server._websock_server._broadcast_buffer.message_from_id.values()]
        assert "GuiImageMessage" in sent and "GuiDropdownMessage" in sent
        assert "master &lt;b&gt;" in shown.page._words.content and "<b>slave</b>" in shown.page._words.content
        assert "GuiButtonGroupMessage" not in sent, "nobody can move these arms"
    finally:
        shown.close()


def test_two_pages_do_not_share_a_port_and_messages_do_not_pile_up(tmp_path):
    source = simulated(tmp_path)
    source.connect()
    page = Page(source, port=0)
    try:
        port = page._server.get_port()
        with pytest.raises(InputError, match=f"127.0.0.1:{port}"):
            Page(source, port=port)
        kept = page._server._websock_server._broadcast_buffer.message_from_id
        counts = []
        for frame in range(600):
            for _ in range(33):
                source.tick()
            page.update()
            if frame == 200:
                source.hold(0, 0.0)
            counts.append(len(kept))
        assert max(counts[300:]) <= max(counts[:300]) + 5, "one message per thing, however long it runs"
        assert page._server.request_share_url() is None
    finally:
        page.close()
        source.stop()

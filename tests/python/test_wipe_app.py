"""``palpate wipe`` and what it leaves: options, report, recording, film, live page."""

from __future__ import annotations

import threading
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="palpate[vision] is not installed")
pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
pytest.importorskip("shapely", reason="palpate[wipe] is not installed")
pytest.importorskip("statemachine", reason="palpate[wipe] is not installed")

from palpate import vision, wipe  # noqa: E402
from palpate.cli import main  # noqa: E402
from palpate.cli import wipe as verb  # noqa: E402
from palpate.cli._common import is_report  # noqa: E402
from palpate.cli._page import LivePage  # noqa: E402
from palpate.errors import InputError  # noqa: E402
from palpate.logs import Log  # noqa: E402
from palpate.report import WipeReport, write_wipe_report  # noqa: E402
from palpate.wipe import film  # noqa: E402

ROWS = 500
"""2 s of 4 ms"""


@pytest.fixture
def palpate(capsys, tmp_path, monkeypatch):
    """Run the command in an empty folder: code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        code = main([str(a) for a in arguments])
        told = capsys.readouterr()
        return code, told.out, told.err

    return run


def report(**changes):
    """A made-up job: the eraser slides along the board from 0.5 s to 1.5 s."""
    time = 0.004 * np.arange(ROWS)
    sliding = (time > 0.5) & (time < 1.5)
    force = np.where(sliding, 2.5, 0.0)
    tool = np.stack([0.1 + 0.1 * time, np.full(ROWS, 0.1), np.where(sliding, 0.0, 0.03)], 1)
    values = {
        "title": "A <board> wiped",
        "arm": "two arms",
        "verdict": "clean",
        "reason": "",
        "ink_before": 0.004,
        "ink_after": 1e-5,
        "simulated": 2.0,
        "wall": 1.0,
        "max_force": 5.0,
        "max_torque": 2.0,
        "band": 0.5,
        "time_s": time,
        "phase": np.where(sliding, "slide", "approach"),
        "wanted": force,
        "estimated": force + 0.1 * np.sin(30.0 * time),
        "normal": force + 0.2 * np.sin(40.0 * time),
        "contact": 1.1 * force,
        "force": np.full(ROWS, 3.0),
        "moment": np.full(ROWS, 0.5),
        "tool": tool,
        "moved": np.where(sliding, 1e-3, np.nan),
        "yielding": np.zeros(ROWS, bool),
        "size": (0.4, 0.3),
        "coverage": np.ones((30, 40), np.float32),
        "before": cv2.imencode(".jpg", np.full((90, 160, 3), 200, np.uint8))[1].tobytes(),
        "after": None,
        "passes": [{"pass": "1", "took": "1 s"}],
        "events": [(0.5, "task", "pass 1: <b>one</b> stroke")],
        "timing": [{"activity": "control", "median": "0.1 ms"}],
        "settings": {"speed": "0.1 m/s"},
    }
    return WipeReport(**{**values, **changes})


# -- options ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--within", "0.1,0.2,0.3"], "--within: expected X0,Y0,X1,Y1"),
        (["--without", "a,b,c,d"], "--without: expected numbers [m]"),
        (["--within", "0.1,0.1,0.1,0.2"], "opposite corners of a rectangle"),
        (["--colour", "mauve"], "no colour 'mauve'"),
        (["--hold", "maybe"], "always, needed, never"),
        (["--force", "6"], "normal_force must be below max_force"),
        (["--magnet", "3,3"], "--magnet: expected X,Y on the board"),
        (["--tilt", "80"], "tilt must be at most 45 degrees"),
        (["--ink", "none.png"], "none.png: cannot be read"),
        (["--ink", "none.png", "--text", "a"], "--ink and --text"),
        (["--board-size", "0", "0.3"], "finite lengths > 0 m"),
        (["--video", "film.avi"], "a name that ends in .mp4"),
        (["--view", "--port", "70000"], "no page can be served at port 70000"),
    ],
)
def test_wrong_input_is_one_line_and_nothing_is_written(palpate, tmp_path, arguments, words):
    code, out, err = palpate("wipe", *arguments, "--no-record")
    assert code == 2
    assert words in err
    assert len(err.strip().splitlines()) == 1
    assert not out
    assert not list(tmp_path.iterdir())


def test_foreign_files_are_not_replaced(palpate, tmp_path):
    (tmp_path / "report.html").write_text("mine")
    code, _, err = palpate("wipe")
    assert code == 2
    assert "was not written by palpate" in err
    assert (tmp_path / "report.html").read_text() == "mine"


def test_regions():
    assert verb._region("--within", "0.3,0.2,0.1,0.1") == ((0.1, 0.1), (0.3, 0.1), (0.3, 0.2), (0.1, 0.2))
    assert verb._region("--within", "0,0,1,0,0,1") == ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))


def test_what_is_on_the_board(tmp_path):
    picture = np.full((120, 160, 3), 255, np.uint8)
    picture[40:80, 40:120] = (255, 0, 0)  # blue as OpenCV writes it
    cv2.imwrite(str(tmp_path / "ink.png"), picture)
    layer, setting = verb._board(0, tmp_path / "ink.png", (), (0.4, 0.3), 5.0, ["0.05,0.06"])
    assert layer.size == (0.4, 0.3)
    assert layer.area == pytest.approx(0.4 * 0.3 * 40 * 80 / (120 * 160), rel=0.1)
    assert layer.colour[150, 200, 2] > 200 > layer.colour[150, 200, 0]  # red, green, blue
    assert setting.magnets == ((0.05, 0.06),)
    assert setting.tilt == pytest.approx(np.radians(5.0))
    same = [verb._board(3, None, (), None, None, ())[0].amount for _ in range(2)]
    assert np.array_equal(*same)
    written = verb._board(0, None, ["one", "two"], (0.4, 0.3), None, ())[0].visible
    assert written[:150].any() and written[150:].any()


# -- report -----------------------------------------------------------------------------------------


def test_report_is_one_page_that_fetches_and_runs_nothing(tmp_path):
    first = write_wipe_report(report(), tmp_path / "a.html").read_bytes()
    second = write_wipe_report(report(), tmp_path / "b.html").read_bytes()
    assert first == second
    assert is_report(first)  # the next run may replace it
    page = first.decode()
    assert "<script" not in page
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "")
    assert "<b>one</b>" not in page
    assert "0.25 <small>% of the ink left" in page
    assert "image/jpeg" in page
    assert "100 %" in page  # of the time within the band
    for heading in ("Before and after", "Force", "Way and coverage", "Passes", "What happened", "Timing"):
        assert f"<h2>{heading}</h2>" in page


def test_report_of_a_job_that_never_began(tmp_path):
    """No board: no track, no pictures, no passes."""
    none = {
        name: np.zeros(0)
        for name in ("time_s", "wanted", "estimated", "normal", "contact", "force", "moment", "moved")
    }
    empty = report(
        **none,
        phase=np.zeros(0, str),
        yielding=np.zeros(0, bool),
        tool=np.zeros((0, 3)),
        before=None,
        passes=(),
        events=(),
        timing=(),
        verdict="stopped",
        reason="no board was found",
        ink_before=0.0,
        coverage=np.zeros((30, 40), np.float32),
    )
    page = write_wipe_report(empty, tmp_path / "r.html").read_text()
    assert "no board was found" in page
    assert "nan" not in page.lower().replace("dominant", "")


def test_report_checks_shapes():
    with pytest.raises(InputError, match="tool must have shape"):
        report(tool=np.zeros((ROWS, 2)))


# -- recording, film --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene():
    return wipe.BoardScene(wipe.InkLayer((0.4, 0.3)))


def tick(scene, time_ns, **changes):
    n = scene.arms[0].n
    T = np.eye(4)
    T[:3, 3] = 0.4, 0.0, 0.2
    values = {
        **dict.fromkeys(("q", "dq", "tau", "q_holder", "dq_holder", "tau_holder"), np.arange(n) * 0.1),
        **dict.fromkeys(("commanded", "estimated", "estimated_std"), np.arange(6.0)),
        "time_ns": time_ns,
        "wanted_force": 2.5,
        "normal_force": 2.4,
        "true_force": np.array([0.0, 0.0, 2.6]),
        "true_normal": 2.6,
        "T_world_tool": T,
        "T_world_board": T,
        "T_world_board_seen": None,
        "task": "wiping",
        "number": 1,
        "stroke": 0,
        "phase": "slide",
        "yielding": False,
        "held": True,
        "activities": {},
    }
    return wipe.Tick(**{**values, **changes})


def test_recording_holds_what_was_told(scene, tmp_path):
    path = tmp_path / "run.mcap"
    with wipe.RunRecorder(path, scene, wipe.JobOptions(speed=0.2)) as recorder:
        for k in range(50):
            recorder.tick(tick(scene, 4_000_000 * k, tau=np.full(7, np.nan)))
        recorder.event(wipe.Event(196_000_000, "board", "the board moved"))
    log = Log.open(path, keep_invalid=True)
    assert len(log) == 50
    assert log.joint_names[0].startswith("eraser/") and log.joint_names[7].startswith("holder/")
    assert np.isnan(log.effort[:, :7]).all() and np.isfinite(log.effort[:, 7:]).all()
    assert log.signals["true_normal_force"].value == pytest.approx(2.6)
    assert log.signals["commanded_wrench"].value.shape == (50, 6)
    assert "speed=0.2" in log.meta["options"]
    assert any("the board moved" in e.text for e in log.events)
    assert sum(e.kind == "phase" for e in log.events) == 1  # told once, not 50 times


def test_film_draws_at_its_rate_and_says_what_happens(scene, monkeypatch):
    monkeypatch.setattr(wipe.BoardScene, "overview", lambda self, w, h: np.full((h, w, 3), 90, np.uint8))
    job = wipe.WipeJob(scene, wipe.JobOptions())
    shown = []
    watching = wipe.Film(job, shown.append, rate=10.0)
    watching.event(wipe.Event(0, "task", "pass 1"))
    image = np.full((720, 1280, 3), 180, np.uint8)
    watching.look(wipe.Look(0, image, vision.see(image), "before"))
    for k in range(251):
        watching.tick(tick(scene, 4_000_000 * k, normal_force=np.nan if k % 50 < 20 else 2.4))
    assert len(shown) == 11
    assert all(picture.shape == (film.HEIGHT, film.WIDTH, 3) for picture in shown)
    assert film.told(tick(scene, 0, yielding=True), job).startswith("wiping, pass 1, slide")
    with pytest.raises(InputError, match="rate"):
        wipe.Film(job, shown.append, rate=0.0)


def test_video_can_be_read(tmp_path):
    video = wipe.Video(tmp_path / "v.mp4", rate=10.0)
    for level in (0, 120, 240):
        video.show(np.full((film.HEIGHT, film.WIDTH, 3), level, np.uint8))
    video.close()
    assert verb._is_video((tmp_path / "v.mp4").read_bytes())
    reader = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert reader.read()[1].shape == (film.HEIGHT, film.WIDTH, 3)


# -- stop, live page --------------------------------------------------------------------------------


def test_ctrl_c_stops_the_job_once_and_everybody_goes_on_being_told(scene):
    stops, ticks = [], []
    job = SimpleNamespace(stop=lambda: stops.append(1))
    one = SimpleNamespace(tick=ticks.append)
    pressed = threading.Event()
    everyone = verb._everyone(job, [one], pressed.is_set)
    for k in range(6):
        if k == 2:
            pressed.set()
        everyone.tick(tick(scene, 4_000_000 * k))
    assert len(stops) == 1
    assert len(ticks) == 6


def fetch(url, **options):
    return urllib.request.urlopen(urllib.request.Request(url, **options), timeout=60)


def test_live_page_shows_pictures_and_has_buttons():
    done = []
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    with LivePage("wipe", {"pause": lambda: done.append("pause")}) as page:
        assert page.address.startswith("http://127.0.0.1:")
        assert b'<button id="pause">' in fetch(page.address).read()
        page.show(jpeg)
        with fetch(page.address + "pictures") as stream:
            assert stream.readline() == b"--picture\r\n"
            head = [stream.readline() for _ in range(3)]
            assert stream.read(len(jpeg)) == jpeg
            assert f"Content-Length: {len(jpeg)}\r\n".encode() in head
        assert fetch(page.address + "do/pause", data=b"", method="POST").read() == b"ok"
        for path, headers, code in (
            ("do/pause", {"Sec-Fetch-Site": "cross-site"}, 403),
            ("do/fly", {}, 404),
        ):
            with pytest.raises(urllib.error.HTTPError) as refused:
                fetch(page.address + path, data=b"", method="POST", headers=headers)
            assert refused.value.code == code
    assert done == ["pause"]


@pytest.mark.slow
def test_a_small_board_from_the_command_line(palpate, tmp_path):
    code, out, _ = palpate("wipe", "--text", "hi", "--board-size", "0.32", "0.24", "--tilt", "0", "--quiet")
    assert out.startswith("clean")
    assert code == 0
    assert (tmp_path / "report.html").stat().st_size > 50_000
    assert Log.open(tmp_path / "run.mcap").signals["normal_force"].value.size > 1000

"""Reports: the numbers they print, what they escape, that they are whole, small, and the same for the same data."""

from __future__ import annotations

import io
import itertools
import json
import math
import pickle
import re
import subprocess
import sys
import warnings
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from palpate import report as R
from palpate.errors import InputError
from palpate.report import _series
from palpate.report._text import clean, escape, mass_unit, number, rounded, status_text
from palpate.report.figures import normalised_error

matplotlib = pytest.importorskip("matplotlib", reason="palpate[report] is not installed")

EVIL = "</td><script>alert('1')</script>\"' $\\frac{ & -->\x00\u202e\ud800"


def weighing(n: int = 600, joints: int = 2, **changes: object) -> R.WeighReport:
    """A made-up but plausible run: 0.25 kg taken at 1 s, put down at 5 s of 6."""
    rng = np.random.default_rng(1)
    time = np.arange(n) * 0.01
    truth = np.where((time >= 1.0) & (time < 5.0), 0.25, 0.0)
    std = 0.05 / (1.0 + 10.0 * (time % 1.0)) + 1e-3
    status = np.zeros(n, np.uint8)
    status[: n // 20] = 1
    wave = np.sin(time)[:, None] * np.arange(1, joints + 1)
    fields: dict[str, object] = {
        "title": "Weighing",
        "arm": "some_arm",
        "time_s": time,
        "mass": truth + std * rng.normal(size=n),
        "mass_std": std,
        "payload_status": status,
        "truth_mass": [0.0, 0.25, 0.0],
        "truth_time_s": [0.0, 1.0, 5.0],
        "headline_time_s": 4.9,
        "headline_mass": 0.25012,
        "headline_std": 0.0005,
        "time_to_2_percent_s": 1.234,
        "changes": [1.02, 5.03],
        "others": {"published": truth + 0.02},
        "joint_names": [f"joint_{i}" for i in range(joints)],
        "q_measured": wave,
        "q_desired": wave + 0.01,
        "q_estimated": wave,
        "dq_desired": wave,
        "dq_estimated": wave,
        "external_torque": wave + rng.normal(size=wave.shape),
        "external_torque_std": np.ones_like(wave),
        "effort": wave,
        "settings": {"bandwidth": 30.0, "friction": True},
        "repair": ["2 rows dropped"],
        "provenance": ["a paper"],
        "picture": R.encode_png(np.full((30, 40, 3), 200, np.uint8)),
    }
    return R.WeighReport(**(fields | changes))  # type: ignore[arg-type]


class Checker(HTMLParser):
    """Balanced elements, unique ids, references that lead somewhere; collects tags, attributes and visible text."""

    VOID = frozenset(("meta", "br", "img"))

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, self.open
        ids = [v for k, v in self.attributes if k == "id"]
        assert len(ids) == len(set(ids))
        used = re.findall(r"url\(#([^)]+)\)", text) + re.findall(r'href="#([^"]+)"', text)
        assert set(used) == set(ids)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(k, v or "") for k, v in attrs]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(k, v or "") for k, v in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def written(report: R.WeighReport, folder: Path) -> tuple[str, Checker]:
    path = R.write_weigh_report(report, folder / "report.html")
    html = path.read_text(encoding="utf-8")
    assert [p.name for p in folder.iterdir() if p.suffix == ".part"] == []
    return html, Checker(html)


# --- words and numbers ----------------------------------------------------------------------------------------------


def test_statuses_are_those_of_the_core():
    from palpate import _core as core

    assert {s.name: int(s) for s in core.Status} == {status_text(i).name: i for i in range(8)}
    assert status_text(200).name == "status 200"
    assert len({status_text(i).severity for i in range(9)}) == 9


def test_status_meanings_are_those_of_the_manual():
    manual = Path(__file__).parents[2] / "docs" / "conventions.md"
    for i in range(8):
        assert f"| `{status_text(i).name}` | {status_text(i).meaning} |" in manual.read_text(encoding="utf-8")


def test_clean_and_escape():
    assert clean("a\tb\n c") == "a b c"
    assert clean("x\x00\x1b\u202e\ud800") == "x" + "\N{REPLACEMENT CHARACTER}" * 4
    assert clean("y" * 10**6) == "y" * 399 + "…" and clean("关节 é") == "关节 é"
    assert escape("<a href='x'>&\"") == "&lt;a href=&#x27;x&#x27;&gt;&amp;&quot;"
    clean("\ud800" * 500).encode("utf-8")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (True, "yes"),
        (-3, "−3"),
        (804.97, "805"),
        (1000.0, "1000"),
        (250.0, "250"),
        (1e-5, "1e−05"),
        (2.5e9, "2.5e+09"),
        (0.0, "0"),
        (12345, "12345"),
        (-0.123456, "−0.1235"),
        (float("nan"), "–"),
        (float("-inf"), "−∞"),
        (np.float64(2.5), "2.5"),
        ([0.0, -9.81], "0, −9.81"),
        ("a\nb", "a b"),
    ],
)
def test_number(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "spread", "text"),
    [
        (249.9812, 0.0612, ("249.98", "0.06")),
        (249.9812, 0.0212, ("249.981", "0.021")),
        (250.4, 1234.0, ("250", "1234")),
        (-0.01, 2.3, ("0.0", "2.3")),
        (-5.04, 0.3, ("−5.0", "0.3")),
        (1.0, 0.0, ("1", "0")),
        (1.0, math.nan, ("1", "?")),
        (math.nan, 1.0, ("–", "–")),
        (1e-12, 1e-15, ("0.000000000", "0.000000000")),
    ],
)
def test_rounded(value, spread, text):
    assert rounded(value, spread) == text


def test_mass_unit():
    assert mass_unit([0.25, math.nan]) == (1e3, "g")
    assert mass_unit([0.2, -3.0]) == (1.0, "kg")
    assert mass_unit([]) == (1e3, "g")


# --- series ---------------------------------------------------------------------------------------------------------

floats = st.floats(-1e6, 1e6) | st.just(math.nan)


@given(hnp.arrays(float, st.integers(0, 400), elements=floats), st.integers(8, 60))
def test_envelope_keeps_extremes_and_breaks(y, limit):
    x = np.arange(len(y), dtype=float)
    xs, ys = _series.envelope(x, y, limit)
    assert len(xs) <= max(limit + 2, 5) or len(xs) == len(y) <= limit
    assert np.all(np.diff(xs) > 0)
    index = xs.astype(int)
    assert np.array_equal(y[index], ys, equal_nan=True)
    if len(y):
        assert index[0] == 0 and index[-1] == len(y) - 1
        assert np.isnan(y).any() == np.isnan(ys).any()
        if not np.isnan(y).all():
            assert (np.nanmin(ys), np.nanmax(ys)) == (np.nanmin(y), np.nanmax(y))


@given(hnp.arrays(float, st.integers(1, 300), elements=floats), st.integers(2, 50))
def test_band_is_never_narrower(middle, limit):
    x = np.arange(len(middle), dtype=float)
    low, high = middle - 1.0, middle + 2.0
    xs, lows, highs = _series.band(x, low, high, limit)
    assert len(xs) <= limit + 1 and xs[0] == x[0] and xs[-1] == x[-1]
    column = np.clip(np.searchsorted(xs, x, side="right") - 1, 0, None)
    known = np.isfinite(middle)
    assert np.all(lows[column][known] <= low[known]) and np.all(highs[column][known] >= high[known])


def test_break_at_gaps():
    x = np.array([0.0, 0.1, 0.2, 1.0, 1.1])
    t, y = _series.break_at_gaps(x, x)
    np.testing.assert_array_equal(y, [0.0, 0.1, 0.2, math.nan, 1.0, 1.1])
    assert t[3] == pytest.approx(0.6)
    for same in (np.arange(3.0), np.zeros(4), np.array([0.0, 9.0]), np.array([3.0, 2.0, 1.0])):
        assert len(_series.break_at_gaps(same)[0]) == len(same)


def test_alone():
    assert _series.alone(np.array([1.0, math.nan, 2.0, 3.0, math.nan, 4.0])).tolist() == [0, 5]
    assert _series.alone(np.array([1.0])).tolist() == [0]
    assert _series.alone(np.empty(0)).tolist() == []


def test_limits():
    assert _series.limits([]) == (-1.0, 1.0)
    assert _series.limits([np.array([math.nan])]) == (-1.0, 1.0)
    low, high = _series.limits([np.zeros(5)])
    assert low < 0.0 < high
    low, high = _series.limits([np.append(np.linspace(0.0, 1.0, 1000), 1e6)])
    assert -0.5 < low < 0.0 and 1.0 < high < 3.0
    low, high = _series.limits([np.array([0.0, 10.0])])
    assert low < 0.0 and high > 10.0


def test_spans():
    time = np.arange(6.0)
    assert _series.spans(time, np.array([1, 1, 0, 0, 4, 0], np.uint8)) == [
        (0.0, 2.0, 1),
        (2.0, 4.0, 0),
        (4.0, 5.0, 4),
        (5.0, 5.0, 0),
    ]
    assert _series.spans(np.empty(0), np.empty(0, np.uint8)) == []
    long = np.zeros(100_000, np.uint8)
    long[54_321] = 4  # one bad sample is never hidden by many good ones
    spans = _series.spans(np.arange(100_000.0), long)
    assert len(spans) == 3 and spans[1][2] == 4


# --- the data -------------------------------------------------------------------------------------------------------


def test_headline_and_truth():
    r = weighing(headline_mass=None, headline_std=None)
    assert r.headline.mass == r.mass[490] and r.headline.std == r.mass_std[490]
    assert (r.headline.time_s, r.headline.status, r.headline.truth) == (4.9, 0, 0.25)
    np.testing.assert_array_equal(r.truth_at([-1.0, 0.5, 1.0, 5.0]), [math.nan, 0.0, 0.25, 0.0])
    begin, end = r.settled
    assert 2.0 < begin < end == 4.9  # after the object was taken
    given_mass = weighing(headline_mass=1.0, headline_std=None, headline_status=2)
    assert math.isnan(given_mass.headline.std) and given_mass.headline.status == 2
    constant = weighing(truth_mass=0.25, truth_time_s=None)
    assert constant.headline.truth == 0.25 and constant.truth_known
    assert not weighing(truth_mass=None, truth_time_s=None).truth_known
    empty = R.WeighReport(title="", time_s=[], mass=[])
    assert empty.headline.status == 1 and math.isnan(empty.headline.mass) and empty.row_at(0.0) is None


def test_report_is_immutable_and_pickles():
    r = weighing()
    for array in (r.time_s, r.mass, r.payload_status, r.others["published"], r.q_measured):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    copy = pickle.loads(pickle.dumps(r))
    assert copy.settings == r.settings and copy.headline == r.headline
    np.testing.assert_array_equal(copy.mass, r.mass)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_s": [0.0, math.nan]}, "time_s must be finite and of shape (N,), got shape (2,)"),
        ({"mass": [1.0]}, "mass must have shape (600,), got (1,)"),
        ({"mass": "heavy"}, "mass must be numbers, got 'heavy'"),
        ({"mass_std": -np.ones(600)}, "mass_std must be >= 0, got -1"),
        ({"payload_status": np.full(600, 256)}, "payload_status must hold numbers of 0 to 255"),
        ({"q_measured": np.zeros((600, 3))}, "q_measured must have shape (600, 2), got (600, 3)"),
        ({"external_torque_std": -np.ones((600, 2))}, "external_torque_std must be >= 0, got -1"),
        ({"joint_kinds": ["wheel"] * 2}, "joint_kinds must be revolute or prismatic"),
        ({"truth_time_s": [0.0, 2.0, 1.0]}, "truth_time_s must ascend"),
        ({"truth_mass": [1.0]}, "truth_mass must have shape (3,), got (1,)"),
        ({"truth_time_s": None}, "truth_mass (without truth_time_s) must be a number"),
        ({"others": {"x": [1.0]}}, "others['x'] must have shape (600,), got (1,)"),
        ({"headline_mass": "much"}, "headline_mass must be a number, got 'much'"),
    ],
)
def test_wrong_data(changes, message):
    with pytest.raises(InputError, match=re.escape(message)):
        weighing(**changes)


def test_normalised_error():
    r = weighing()
    z = normalised_error(r)
    assert np.isnan(z[:30]).all()
    np.testing.assert_allclose(z[30:], ((r.mass - r.truth_at(r.time_s)) / r.mass_std)[30:])
    assert np.isnan(normalised_error(weighing(mass_std=np.zeros(600)))).all()


# --- the page -------------------------------------------------------------------------------------------------------


def test_page_says_the_numbers(tmp_path):
    _, page = written(weighing(), tmp_path)
    text = page.text
    for expected in (
        "Weighing some_arm · 5.99 s, 600 samples at 100 Hz",
        "250.1 g ± 1.0 g",
        "± is half of the 95 % interval (1.96 σ), known at 4.9 s",
        "ok use the number and its standard deviation",
        "truth 250 g",
        "error +0.12 g +0.048 %, 0.24 σ",
        "time to 2 % 1.23 s",
        "changes of load found 2",
        "ok 95.0 %: use the number",
        "warming 5.0 %: too little has been seen",
        "published 270 g +20 g 20 g",
        "positive when the environment pushes the robot",
        "bandwidth 30 friction yes",
        "2 rows dropped",
        "a paper",
    ):
        assert expected in text, expected
    # 2 of the mass, 2 of the error, and positions, speeds, torques, efforts of 2 joints
    assert page.tags.count("svg") == 12


def test_page_fetches_and_runs_nothing(tmp_path):
    html, page = written(weighing(), tmp_path)
    assert "default-src &#x27;none&#x27;" in html or "default-src 'none'" in html
    assert {"script", "link", "iframe", "object", "use-external"}.isdisjoint(page.tags)
    assert not re.search(r"https?:|//[a-z]", html.replace("data:image/png;base64,", ""))
    assert all(
        v.startswith(("#", "data:image/png;base64,")) for k, v in page.attributes if k in ("href", "src")
    )
    assert not any(k.startswith("on") for k, _ in page.attributes)
    assert "@import" not in html and "url(http" not in html


def test_same_data_same_bytes(tmp_path):
    first, _ = written(weighing(), tmp_path)
    with matplotlib.rc_context(
        {"font.size": 30, "axes.facecolor": "red", "svg.hashsalt": None, "text.usetex": True}
    ):
        second, _ = written(weighing(), tmp_path)
    assert first == second
    assert (
        R.hero_picture(weighing(), tmp_path / "a.png").read_bytes()
        == R.hero_picture(weighing(), tmp_path / "b.png").read_bytes()
    )


def test_matplotlib_settings_are_left_alone(tmp_path):
    before = dict(matplotlib.rcParams)
    written(weighing(), tmp_path)
    with pytest.raises(InputError):
        R.coverage_figure([1.0], [-1.0])
    assert dict(matplotlib.rcParams) == before


def test_no_pyplot():
    code = (
        "import sys, numpy as np; from palpate import report as R; assert 'matplotlib' not in sys.modules;"
        "R.mass_figure(R.WeighReport(title='', time_s=np.arange(50.), mass=np.ones(50)));"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_matplotlib(tmp_path):
    code = (
        "import sys; sys.modules['matplotlib'] = None; sys.modules['PIL'] = None\n"
        "from palpate import report as R\n"
        "from palpate.errors import MissingExtraError\n"
        f"R.write_study([R.StudyRow('a', 1, 1, 0, True)], {{}}, {str(tmp_path / 's')!r})\n"
        "r = R.WeighReport(title='', time_s=[0.], mass=[1.])\n"
        "for f in (lambda: R.write_weigh_report(r, 'x'), lambda: R.mass_figure(r), lambda: R.encode_png([[[0]]])):\n"
        "    try: f()\n"
        "    except MissingExtraError as e: assert 'palpate[report]' in str(e)\n"
        "    except Exception as e: assert 'picture must have shape' in str(e)\n"
        "    else: raise SystemExit(1)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_text_from_outside_is_only_text(tmp_path):
    evil = weighing(
        joints=3,
        title=EVIL,
        arm=EVIL,
        joint_names=[EVIL, "$x^", "关节\n3"],
        others={EVIL: np.zeros(600), "$": np.ones(600)},
        effort_unit=EVIL,
        settings={EVIL: EVIL},
        repair=[EVIL],
        provenance=[EVIL],
    )
    _, page = written(evil, tmp_path)
    assert "script" not in page.tags
    assert page.text.count("<script>alert('1')</script>") >= 6
    R.save_png(R.mass_figure(evil), tmp_path / "mass.png")
    R.hero_picture(evil, tmp_path / "hero.png")
    rows = [R.StudyRow(EVIL, EVIL, EVIL, EVIL, False, EVIL, EVIL)]
    figures = {EVIL: R.table_figure(rows, title=EVIL)}
    files = R.write_study(
        rows, figures, tmp_path / "s", title=EVIL, text=EVIL, settings={EVIL: 1}, provenance=[EVIL]
    )
    study = Checker(files.html.read_text(encoding="utf-8"))
    assert "script" not in study.tags and "<script>" in study.text
    assert "<script" not in files.markdown.read_text(encoding="utf-8")
    assert json.loads(files.json.read_text())["rows"][0]["what"].startswith("</td>")


@pytest.mark.parametrize("n", [0, 1, 2, 3, 19, 20])
def test_few_samples(tmp_path, n):
    rows = slice(0, n)
    full = weighing()
    changes = {
        name: getattr(full, name)[rows]
        for name in (
            "time_s",
            "mass",
            "mass_std",
            "payload_status",
            *(f for f in dir(full) if f.startswith(("q_", "dq_"))),
        )
        if getattr(full, name) is not None
    }
    changes |= {f: getattr(full, f)[rows] for f in ("external_torque", "external_torque_std", "effort")}
    r = weighing(
        **changes,
        others={"published": full.mass[rows]},
        headline_time_s=None,
        headline_mass=None,
        headline_std=None,
    )
    _, page = written(r, tmp_path)
    assert ("no samples" in page.text) == (n == 0)
    R.mass_figure(r) if n else None
    R.hero_picture(r, tmp_path / "hero.png") if n else None


def test_only_a_mass(tmp_path):
    _, page = written(R.WeighReport(title="x", time_s=np.arange(100.0), mass=np.full(100, 3.0)), tmp_path)
    assert "3 kg" in page.text and "no standard deviation was given" in page.text
    assert page.tags.count("svg") == 2


@pytest.mark.parametrize("hole", [math.nan, math.inf, -math.inf, 1e308])
def test_holes_in_every_series(tmp_path, hole):
    rng = np.random.default_rng(0)

    def holed(value: np.ndarray, share: float = 0.3) -> np.ndarray:
        value = np.array(value)
        value[rng.random(value.shape) < share] = hole
        return value

    full = weighing()
    names = ("mass", "q_measured", "q_desired", "q_estimated", "dq_estimated", "external_torque", "effort")
    changes: dict[str, object] = {name: holed(getattr(full, name)) for name in names}
    changes["mass_std"] = np.abs(holed(full.mass_std))
    changes["others"] = {"published": holed(full.mass), "never": np.full(600, hole)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        html, page = written(weighing(**changes), tmp_path)
        assert "nan" not in re.sub(r"base64,[^\"]*", "", html).lower().replace("non_finite", "")
        everything = weighing(
            mass=np.full(600, hole), external_torque=np.full((600, 2), hole), headline_mass=None
        )
        _, page = written(everything, tmp_path)
        assert "– g" in page.text
        R.hero_picture(everything, tmp_path / "hero.png")


def test_wild_start_is_off_the_scale_but_named(tmp_path):
    mass = np.full(600, 0.25)
    mass[:5] = (40.0, -30.0, 20.0, 3.0, 0.3)
    r = weighing(mass=mass, truth_mass=0.25, truth_time_s=None, others={})
    figure = R.mass_figure(r)
    low, high = figure.axes[0].get_ylim()
    assert -100.0 < low <= 0.0 and 250.0 < high < 500.0
    texts = [t.get_text() for t in figure.axes[0].texts]
    assert any("↑ 40000 g" in t for t in texts) and any("↓ −30000 g" in t for t in texts)


def test_labels_do_not_overlap():
    r = weighing(others={f"estimator number {i}": np.full(600, 0.25) for i in range(5)})
    figure = R.mass_figure(r)
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figure.savefig(io.BytesIO(), format="png")
    labels = [t for t in figure.axes[0].texts if t.get_text().startswith(("estimator", "truth", "palpate"))]
    boxes = sorted((t.get_window_extent() for t in labels), key=lambda b: b.y0)
    assert len(boxes) == 7
    assert all(b.y0 >= a.y1 - 1.0 for a, b in itertools.pairwise(boxes))


def test_gap_in_time_is_a_gap_in_the_line():
    time = np.concatenate((np.arange(300) * 0.01, 10.0 + np.arange(300) * 0.01))
    ones = np.ones((600, 1))
    figure = R.joints_figure(time, {"measured": ones, "desired": ones}, ["a"])
    assert all(np.isnan(line.get_ydata()).sum() == 1 for line in figure.axes[0].lines)


@pytest.mark.parametrize("kinds", [None, ("prismatic", "revolute")])
def test_units(tmp_path, kinds):
    html, _ = written(weighing(joints=2, joint_kinds=kinds), tmp_path)
    assert ("position [m]" in html) == (kinds is not None) and "position [rad]" in html
    assert ("torque [N]" in html) == (kinds is not None) and "torque [N m]" in html
    assert "speed [rad/s]" in html


def test_long_logs_stay_small(tmp_path):
    n, joints = 120_000, 16
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(n, joints))
    names = ("q_measured", "q_desired", "q_estimated", "dq_measured", "dq_desired", "dq_estimated", "effort")
    r = R.WeighReport(
        title="noise",
        time_s=np.arange(n) * 1e-3,
        mass=rng.normal(size=n),
        mass_std=rng.random(n),
        payload_status=rng.integers(0, 8, n),
        truth_mass=0.0,
        others={"a": rng.normal(size=n), "b": rng.normal(size=n)},
        changes=np.arange(500.0),
        joint_names=[f"j{i}" for i in range(joints)],
        external_torque=noise,
        external_torque_std=np.ones_like(noise),
        **dict.fromkeys(names, noise),  # type: ignore[arg-type]
    )
    html, _ = written(r, tmp_path)
    assert len(html.encode()) < 1_500_000


def test_cannot_write(tmp_path):
    with pytest.raises(InputError, match="cannot write .*No such file or directory"):
        R.write_weigh_report(weighing(), tmp_path / "no" / "report.html")
    with pytest.raises(InputError, match="cannot write .*Is a directory"):
        R.write_weigh_report(weighing(), tmp_path)


@pytest.mark.parametrize("picture", [b"", b"GIF89a", b"\x89PNG\r\n\x1a\nxxxx"])
def test_wrong_picture(tmp_path, picture):
    broken = weighing(picture=picture)
    with pytest.raises(InputError, match="the picture is not a readable PNG"):
        R.write_weigh_report(broken, tmp_path / "x.html")
    with pytest.raises(InputError, match="the picture is not a readable PNG"):
        R.hero_picture(broken, tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []


# --- figures --------------------------------------------------------------------------------------------------------


def size_of(png: Path) -> tuple[int, int]:
    data = png.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])


def test_hero_picture(tmp_path):
    path = R.hero_picture(weighing(), tmp_path / "hero.png")
    assert size_of(path) == (1600, 700)
    for shape in ((10, 2000, 3), (2000, 10, 3), (1, 1, 3)):
        R.hero_picture(weighing(picture=R.encode_png(np.zeros(shape, np.uint8))), path)
    with pytest.raises(InputError, match="needs a report with a picture"):
        R.hero_picture(weighing(picture=None), path)


def test_encode_png():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    from palpate.report._style import decode_png

    np.testing.assert_array_equal(decode_png(R.encode_png(pixels)), pixels)
    for wrong in (pixels[..., 0], pixels.astype(float), np.zeros((0, 4, 3), np.uint8)):
        with pytest.raises(
            InputError,
            match="a picture must have shape (height, width, 3) and type uint8".replace("(", "\\(").replace(
                ")", "\\)"
            ),
        ):
            R.encode_png(wrong)


def test_joint_figures(tmp_path):
    r = weighing(joints=3)
    curves = {"measured": r.q_measured, "desired": r.q_desired}
    figure = R.joints_figure(r.time_s, curves, r.joint_names, columns=2, notes=["a", "b", "c"])
    assert len(figure.axes) == 3 and len(figure.legends) == 1
    R.save_png(figure, tmp_path / "j.png")
    torque = R.torque_figure(r.time_s, r.external_torque, r.external_torque_std, r.joint_names)
    assert "at the end" in torque.axes[0].get_title(loc="right")
    R.torque_figure(r.time_s, r.external_torque, None, r.joint_names, key=False)
    R.joints_figure([], {"measured": np.empty((0, 0))}, [])
    for wrong, message in (
        ({"curves": {"x": np.zeros((5, 3))}}, "curve 'x' must have shape (600, 3), got (5, 3)"),
        ({"columns": 0}, "columns must be >= 1, got 0"),
        ({"unit": ["rad"]}, "one text per joint, 3"),
        ({"std": np.zeros(3)}, "std must have shape (600, 3), got (3,)"),
        ({"time_s": [[0.0]]}, "time_s must be finite and of shape (N,), got shape (1, 1)"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            R.joints_figure(**({"time_s": r.time_s, "curves": curves, "joint_names": r.joint_names} | wrong))


def test_coverage_figure(tmp_path):
    errors = np.random.default_rng(3).normal(size=400)
    figure = R.coverage_figure(errors, np.ones(400))
    inside = 100.0 * np.mean(np.abs(errors) <= 1.959964)
    assert any(f"truth in {inside:.1f} %" in t.get_text() for t in figure.axes[0].texts)
    R.save_png(figure, tmp_path / "c.png")
    R.coverage_figure([], [])
    R.coverage_figure([math.nan, 1.0], [1.0, math.inf])
    with pytest.raises(InputError, match="same shape"):
        R.coverage_figure([1.0], [1.0, 2.0])
    with pytest.raises(InputError, match="std must be > 0"):
        R.coverage_figure([1.0], [0.0])


def test_table_figure():
    row = R.StudyRow("a", 1, 2, 0.1, True)
    assert R.table_figure([row] * 40, title="t").axes
    assert R.table_figure([]).axes
    with pytest.raises(InputError, match="at most 40 rows, got 41"):
        R.table_figure([row] * 41)


# --- studies --------------------------------------------------------------------------------------------------------

ROWS = [
    R.StudyRow("mass", 250, np.float64(249.9), 5, True, "g"),
    R.StudyRow("time | to 2 %", "<= 2.5", 3.0, None, False, "s", "slow_er*"),
    R.StudyRow("peak", None, math.nan),
]


def test_markdown_table():
    assert R.markdown_table(ROWS) == (
        "| quantity | published or required | palpate | tolerance | holds | note |\n"
        "| --- | ---: | ---: | ---: | :---: | --- |\n"
        "| mass \\[g\\] | 250 | 249.9 | 5 | ✓ ok |  |\n"
        "| time \\| to 2 % \\[s\\] | &lt;= 2.5 | 3 | – | ✗ no | slow\\_er\\* |\n"
        "| peak | – | – | – |  |  |\n"
    )
    assert R.markdown_table([]).count("\n") == 2
    with pytest.raises(InputError, match="ok of 'a' must be True, False or None, got 1"):
        R.StudyRow("a", ok=1)  # type: ignore[arg-type]
    assert R.StudyRow("a", ok=np.bool_(True)).ok is True  # type: ignore[arg-type]


def test_write_study(tmp_path):
    r = weighing()
    foreign = matplotlib.figure.Figure()
    foreign.add_subplot().loglog([1, 10], [1, 100])  # not made here
    figures = {"The mass.": R.mass_figure(r), "Foreign": foreign}
    for name in ("study", "study.html", "study.json"):
        files = R.write_study(
            ROWS,
            figures,
            tmp_path / name,
            title="T",
            text="Words.",
            settings={"seeds": np.int64(3)},
            provenance=["x"],
        )
        assert [p.name for p in files] == ["study.html", "study.md", "study.json"]
    page = Checker(files.html.read_text(encoding="utf-8"))
    for expected in ("T Words. 1 of 2 hold", "249.9", "✗ no", "The mass.", "seeds 3", "x"):
        assert expected in page.text
    assert page.tags.count("svg") == 2
    data = json.loads(files.json.read_text())
    assert data["ok"] is False and data["rows"][0]["ours"] == 249.9 and data["rows"][2]["ours"] is None
    assert data["settings"] == {"seeds": 3}
    assert files.markdown.read_text(encoding="utf-8").startswith(
        "# T\n\nWords.\n\n**1 of 2 hold**\n\n| quantity"
    )
    again = [p.read_bytes() for p in files]
    R.write_study(
        ROWS, figures, tmp_path / "study", title="T", text="Words.", settings={"seeds": 3}, provenance=["x"]
    )
    assert [p.read_bytes() for p in files] == again


def test_study_names(tmp_path):
    assert R.write_study([], {}, tmp_path / "v1.2").html.name == "v1.2.html"
    assert json.loads((tmp_path / "v1.2.json").read_text())["ok"] is None


def test_update_markdown(tmp_path):
    path = tmp_path / "results.md"
    R.update_markdown(path, "weigh", "first\n", title="Results")
    assert path.read_text() == "# Results\n\n<!-- begin weigh -->\n\nfirst\n\n<!-- end weigh -->\n"
    R.update_markdown(path, "wipe", "other")
    path.write_text(path.read_text().replace("<!-- begin wipe", "by hand\n\n<!-- begin wipe"))
    R.update_markdown(path, "weigh", "second")
    assert path.read_text() == (
        "# Results\n\n<!-- begin weigh -->\n\nsecond\n\n<!-- end weigh -->\n\nby hand\n\n"
        "<!-- begin wipe -->\n\nother\n\n<!-- end wipe -->\n"
    )
    before = path.read_bytes()
    R.update_markdown(path, "weigh", "second")
    assert path.read_bytes() == before
    path.write_bytes(before.replace(b"\n", b"\r\n"))
    R.update_markdown(path, "weigh", "a\nb")
    assert b"a\r\nb" in path.read_bytes() and path.read_bytes().count(b"\n") == path.read_bytes().count(
        b"\r\n"
    )


@pytest.mark.parametrize(
    ("content", "name", "text", "message"),
    [
        (
            "<!-- begin a -->",
            "a",
            "x",
            "expected one '<!-- begin a -->' followed by one '<!-- end a -->', found 1 and 0",
        ),
        ("<!-- end a --><!-- begin a -->", "a", "x", "found 1 and 1"),
        ("<!-- begin a --><!-- begin a --><!-- end a -->", "a", "x", "found 2 and 1"),
        ("", "a b", "x", "name of a section must be letters"),
        ("", "a", "<!-- end a -->", "holds a section marker itself"),
        ("\xff", "a", "x", "cannot read"),
    ],
)
def test_update_markdown_refuses(tmp_path, content, name, text, message):
    path = tmp_path / "r.md"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(InputError, match=re.escape(message)):
        R.update_markdown(path, name, text)
    assert path.read_bytes() == content.encode("latin-1")

"""The registry of published recordings: found offline, checked, downloaded only after its licence was shown."""

from __future__ import annotations

import hashlib
import sys
import types
from pathlib import Path

import pytest

from palpate import data
from palpate.errors import InputError, LogError, MissingExtraError
from recordings import data_folder

BYTES = b"time,position_1\n0,0\n"


@pytest.fixture
def alone(monkeypatch, tmp_path):
    """Neither PALPATE_DATA, nor a checkout, nor a cache: an empty machine; returns its cache."""
    monkeypatch.delenv("PALPATE_DATA", raising=False)
    monkeypatch.setattr(data, "_above", lambda folder: ())
    cache = tmp_path / "cache"
    monkeypatch.setattr(data, "_cache", lambda pooch, found: cache / found.folder)
    return cache


@pytest.fixture
def toy(monkeypatch):
    """A set of one small file without a licence."""
    file = data.DataFile("log.csv", "some/log.csv", hashlib.sha256(BYTES).hexdigest(), len(BYTES))
    toy = data.DataSet("toy", "A toy", "toy_folder", "nobody/toy", "a" * 40, "Nobody, 2024", (file,))
    monkeypatch.setattr(data, "SETS", {"toy": toy})
    return toy


class Pooch(types.ModuleType):
    """What palpate uses of pooch, with a made-up network."""

    def __init__(self, answer: bytes | Exception) -> None:
        super().__init__("pooch")
        self.answer = answer
        self.asked: list[str] = []

    def get_logger(self):
        import logging

        return logging.getLogger("made-up pooch")

    def retrieve(self, url, known_hash, fname, path):
        self.asked.append(url)
        if isinstance(self.answer, Exception):
            raise self.answer
        if known_hash != "sha256:" + hashlib.sha256(self.answer).hexdigest():
            raise ValueError(f"SHA256 hash of downloaded file ({fname}) does not match\nand more")
        path.mkdir(parents=True, exist_ok=True)
        (path / fname).write_bytes(self.answer)
        return str(path / fname)


def network(monkeypatch, answer: bytes | Exception) -> Pooch:
    pooch = Pooch(answer)
    monkeypatch.setitem(sys.modules, "pooch", pooch)
    return pooch


# -- the registry -----------------------------------------------------------------------------------------------------


def test_every_entry_is_complete():
    for entry in data.list_sets():
        assert data.SETS[entry.name] is entry
        assert len(entry.commit) == 40 and set(entry.commit) <= set("0123456789abcdef")
        assert entry.repository.count("/") == 1
        assert entry.citation and entry.title
        assert entry.size == sum(f.size for f in entry.files) > 0
        for file in entry.files:
            assert len(file.sha256) == 64 and set(file.sha256) <= set("0123456789abcdef")
            assert entry.url(file).startswith("https://raw.githubusercontent.com/")
            assert Path(file.name).name == file.name  # stays in its folder
        assert entry.licence is None or entry.licence in entry.terms


def test_registry_agrees_with_the_sums_beside_the_data():
    sums = data_folder() / "SHA256SUMS"
    known = {
        path.removeprefix("./"): sha for sha, path in (line.split() for line in sums.read_text().splitlines())
    }
    for entry in data.list_sets():
        for file in entry.files:
            path = f"{entry.folder}/{file.name}"
            assert known[path] == file.sha256
            assert (data_folder() / path).stat().st_size == file.size


def test_licence_text_is_the_one_in_the_repository():
    licence = (data_folder() / "lara8_neura_ft" / "LICENSE").read_text()
    assert data.SETS["lara8"].licence_text == licence
    assert licence in data.SETS["lara8"].terms


def test_no_licence_is_said(toy):
    assert toy.licence_name == "no licence: evaluation only, not redistributed"
    assert "do not pass them on" in toy.terms


# -- offline ----------------------------------------------------------------------------------------------------------


def test_the_folder_named_by_the_environment_comes_first(alone, toy, monkeypatch, tmp_path):
    monkeypatch.setenv("PALPATE_DATA", str(tmp_path))
    (tmp_path / "toy_folder").mkdir()
    place = tmp_path / "toy_folder" / "log.csv"
    assert data.path("toy") is None
    place.write_bytes(BYTES)
    assert data.find("toy", "log.csv") == place
    assert data.path("toy") == place.parent
    assert data.get("toy", accept_licence=False) == place.parent  # nothing to download, nobody is asked


def test_beside_a_checkout(alone, toy, monkeypatch, tmp_path):
    clone = tmp_path / "clone"
    (clone / "src" / "palpate").mkdir(parents=True)
    (clone / "src" / "palpate" / "data.py").touch()
    folder = tmp_path / "shared" / "data" / "toy_folder"
    folder.mkdir(parents=True)
    (folder / "log.csv").write_bytes(BYTES)
    below = clone / "examples"
    below.mkdir()
    monkeypatch.setattr(data, "_above", lambda start: (start, *start.parents) if start == below else ())
    monkeypatch.chdir(below)
    assert data.find("toy", "log.csv") == folder / "log.csv"


def test_a_changed_file_is_refused_also_after_it_was_good(alone, toy, monkeypatch, tmp_path):
    monkeypatch.setenv("PALPATE_DATA", str(tmp_path))
    (tmp_path / "toy_folder").mkdir()
    place = tmp_path / "toy_folder" / "log.csv"
    place.write_bytes(BYTES)
    data.find("toy", "log.csv")
    place.write_bytes(BYTES + b"1,1\n")
    for ask in (lambda: data.find("toy", "log.csv"), lambda: data.path("toy")):
        with pytest.raises(LogError, match="log.csv is not the published file: its SHA-256 is"):
            ask()


def test_absent_says_how_to_get_it(alone, toy):
    with pytest.raises(LogError) as caught:
        data.find("toy", "log.csv")
    said = str(caught.value)
    assert "palpate data get toy" in said and "PALPATE_DATA" in said and "toy_folder/log.csv" in said
    assert "\n" not in said


def test_unknown_names_list_the_near_ones(toy):
    with pytest.raises(InputError, match="no data set 'tory'; did you mean 'toy'"):
        data.get("tory", accept_licence=True)
    with pytest.raises(InputError, match="has no file 'log.cvs'; did you mean 'log.csv'"):
        data.find("toy", "log.cvs")


def test_a_wrong_folder_is_said(toy, monkeypatch, tmp_path):
    monkeypatch.setenv("PALPATE_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(LogError, match="PALPATE_DATA is '.*nowhere', which is no folder"):
        data.path("toy")


# -- download ---------------------------------------------------------------------------------------------------------


def test_download_shows_the_terms_first_and_only_once(alone, toy, monkeypatch):
    pooch = network(monkeypatch, BYTES)
    shown = []
    folder = data.get("toy", accept_licence=lambda terms: not shown.append(terms))
    assert shown == [toy.terms]
    assert pooch.asked == [f"https://raw.githubusercontent.com/nobody/toy/{'a' * 40}/some/log.csv"]
    assert (folder / "log.csv").read_bytes() == BYTES
    assert data.find("toy", "log.csv") == folder / "log.csv"  # from the cache
    assert data.get("toy", accept_licence=lambda terms: pytest.fail("asked again")) == folder
    assert len(pooch.asked) == 1


@pytest.mark.parametrize("consent", [False, lambda terms: False])
def test_nothing_is_downloaded_without_consent(alone, toy, monkeypatch, consent):
    pooch = network(monkeypatch, BYTES)
    with pytest.raises(LogError, match="licence .* was not accepted"):
        data.get("toy", accept_licence=consent)
    assert pooch.asked == []


def test_a_wrong_download_and_a_dead_network_are_told_apart(alone, toy, monkeypatch):
    network(monkeypatch, BYTES + b"!")
    with pytest.raises(LogError, match="is not the file that was published: SHA256 hash of downloaded file"):
        data.get("toy", accept_licence=True)
    network(monkeypatch, ConnectionError("x" * 1000))
    with pytest.raises(
        LogError, match=r"cannot be downloaded \(ConnectionError\). Without a network"
    ) as caught:
        data.get("toy", accept_licence=True)
    assert "\n" not in str(caught.value)
    assert data.path("toy") is None


def test_without_pooch_the_extra_is_named(alone, toy, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(MissingExtraError, match=r"palpate\[data\]"):
        data.get("toy", accept_licence=True)
    with pytest.raises(LogError, match="not on this machine"):
        data.find("toy", "log.csv")


def test_pooch_has_what_is_used_of_it():
    import inspect

    pooch = pytest.importorskip("pooch", reason="pooch is not installed")
    assert set(inspect.signature(pooch.retrieve).parameters) >= {"url", "known_hash", "fname", "path"}
    assert str(pooch.os_cache("palpate"))
    cache = data._cache(pooch, data.SETS["lara8"])
    assert cache.name == f"lara8_neura_ft-{data.SETS['lara8'].commit[:12]}"

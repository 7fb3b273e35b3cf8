"""Published recordings of real robots: where they are, under which licence, and how to get them.

palpate carries no recording, because they are not ours to pass on. :func:`find` serves a file from the first of

1. the folder that the environment variable ``PALPATE_DATA`` names,
2. where it names none, ``../shared/data`` beside the checkout, when the program or palpate is run from one,
3. the user's cache, which :func:`get` fills from the original repository (needs ``palpate[data]``),

each laid out as one folder per data set. Every file is checked against its SHA-256 before it is used.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

from .errors import InputError, LogError, MissingExtraError, suggest

VARIABLE = "PALPATE_DATA"
"""environment variable: a folder with one folder per data set"""

Consent: TypeAlias = bool | Callable[[str], bool]
"""True, False, or a function that is shown the terms and says yes or no"""


@dataclass(frozen=True, slots=True)
class DataFile:
    """One file of a data set."""

    name: str
    """in the folder of the data set"""
    path: str
    """in the original repository"""
    sha256: str
    """of its bytes"""
    size: int
    """[bytes]"""


@dataclass(frozen=True, slots=True)
class DataSet:
    """A published recording, at one commit of a public GitHub repository."""

    name: str
    title: str
    folder: str
    """its folder in ``PALPATE_DATA`` and in ``../shared/data``"""
    repository: str
    """``owner/name`` on GitHub"""
    commit: str
    citation: str
    files: tuple[DataFile, ...]
    licence: str | None = None
    """SPDX name; None: the authors gave none, so it may be looked at and not passed on"""
    licence_text: str = ""
    notes: str = ""
    """what one must know before using it"""

    @property
    def size(self) -> int:
        """Of all files [bytes]."""
        return sum(file.size for file in self.files)

    @property
    def origin(self) -> str:
        """Address of the repository."""
        return f"https://github.com/{self.repository}"

    @property
    def licence_name(self) -> str:
        """The licence as listed."""
        return self.licence or "no licence: evaluation only, not redistributed"

    @property
    def terms(self) -> str:
        """What a user must have seen before the download, several lines."""
        head = (
            f"{self.title}\n{self.citation}\nfrom {self.origin} at {self.commit[:12]}, {self.size / 1e6:.1f} MB\n"
            f"Licence: {self.licence_name}\n"
        )
        if self.licence is None:
            return head + "\nThe authors gave no licence. Evaluate with the files, and do not pass them on.\n"
        return head + (f"\n{self.licence_text}" if self.licence_text else "")

    def url(self, file: DataFile) -> str:
        """Address of the raw file."""
        return f"https://raw.githubusercontent.com/{self.repository}/{self.commit}/{file.path}"


_BSD_3 = """BSD 3-Clause License

Copyright (c) {holder}

Redistribution and use in source and binary forms, with or without
modification, are permitted provided that the following conditions are met:

1. Redistributions of source code must retain the above copyright notice, this
   list of conditions and the following disclaimer.

2. Redistributions in binary form must reproduce the above copyright notice,
   this list of conditions and the following disclaimer in the documentation
   and/or other materials provided with the distribution.

3. Neither the name of the copyright holder nor the names of its
   contributors may be used to endorse or promote products derived from
   this software without specific prior written permission.

THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS AND CONTRIBUTORS "AS IS"
AND ANY EXPRESS OR IMPLIED WARRANTIES, INCLUDING, BUT NOT LIMITED TO, THE
IMPLIED WARRANTIES OF MERCHANTABILITY AND FITNESS FOR A PARTICULAR PURPOSE ARE
DISCLAIMED. IN NO EVENT SHALL THE COPYRIGHT HOLDER OR CONTRIBUTORS BE LIABLE
FOR ANY DIRECT, INDIRECT, INCIDENTAL, SPECIAL, EXEMPLARY, OR CONSEQUENTIAL
DAMAGES (INCLUDING, BUT NOT LIMITED TO, PROCUREMENT OF SUBSTITUTE GOODS OR
SERVICES; LOSS OF USE, DATA, OR PROFITS; OR BUSINESS INTERRUPTION) HOWEVER
CAUSED AND ON ANY THEORY OF LIABILITY, WHETHER IN CONTRACT, STRICT LIABILITY,
OR TORT (INCLUDING NEGLIGENCE OR OTHERWISE) ARISING IN ANY WAY OUT OF THE USE
OF THIS SOFTWARE, EVEN IF ADVISED OF THE POSSIBILITY OF SUCH DAMAGE.
"""

_ALL = (
    DataSet(
        name="lara8",
        title="NEURA LARA 8, six joints, motor-current torques and a wrist force/torque sensor",
        folder="lara8_neura_ft",
        repository="allwinlucious/MasterThesis",
        commit="bc06813a1c93b6e58feb1728663e3061689f582b",
        citation=(
            "A. Lucious: Sensor Fusion for Enhanced Joint Torque Estimation based on Machine Learning for "
            "Collaborative Robots with Dual Encoders. Master thesis, RWTH Aachen, 2024"
        ),
        files=(
            DataFile(
                "jogging_linear_mass.csv",
                "utils/ML2/jogging_linear_mass.csv",
                "42a3229c81677e4c3b633883e58d17a34714557454050c7e740739dcdb1ed8b2",
                992114,
            ),
            DataFile(
                "jogging_final.csv",
                "utils/ML2/jogging_final.csv",
                "787f7ccd3fe7376bf88481d86e417b6ce4cf946b5ecde80746791f5e2a169f7e",
                915770,
            ),
            DataFile(
                "friction_parameters_lara8.json",
                "utils/friction_parameters_lara8.json",
                "3a7e9b2580f51a8aa99e552a0950d6d73b9d7637969467eefd4462b1840412d2",
                256,
            ),
            DataFile(
                "LICENSE",
                "LICENSE",
                "a523170419e15aaa913959420a0f184a0b6fdabd481fcbd3ab83c6e807e70388",
                1501,
            ),
        ),
        licence="BSD-3-Clause",
        licence_text=_BSD_3.format(holder="2024, Allwin Lucious"),
        notes="the sensor's force along the tool's z axis, fts_reading_3, has the opposite sign",
    ),
)

SETS: Mapping[str, DataSet] = MappingProxyType({data.name: data for data in _ALL})
"""every data set by name"""


def list_sets() -> tuple[DataSet, ...]:
    """Every data set, here or not; ask :func:`path` where one is."""
    return tuple(SETS.values())


def data_set(name: str) -> DataSet:
    """A data set by name.

    Raises:
        InputError: no such set; names the near ones.
    """
    if name not in SETS:
        raise InputError(f"no data set {name!r}; {suggest(str(name), SETS, 'there are')}")
    return SETS[name]


def path(name: str) -> Path | None:
    """The folder that holds all files of a data set on this machine; None: nowhere, :func:`get` brings them.

    Raises:
        InputError: no such set.
        LogError: ``PALPATE_DATA`` is no folder, or a file cannot be read or differs from the published one.
    """
    data = data_set(name)
    for folder in _folders(data):
        if all((folder / file.name).is_file() for file in data.files):
            for file in data.files:
                _check(folder / file.name, file)
            return folder
    return None


def find(name: str, file: str) -> Path:
    """One file of a data set that is on this machine; nothing is downloaded.

    Args:
        name: the data set.
        file: name of the file.

    Raises:
        InputError: no such set, or no such file in it.
        LogError: it is not on this machine (the message says how to get it), or differs from the published one.
    """
    data = data_set(name)
    known = {f.name: f for f in data.files}
    if file not in known:
        raise InputError(f"data set {name!r} has no file {file!r}; {suggest(str(file), known, 'there are')}")
    for folder in _folders(data):
        if (folder / file).is_file():
            _check(folder / file, known[file])
            return folder / file
    raise LogError(
        f"{file} of data set {name!r} is not on this machine: `palpate data get {name}` fetches it from {data.origin}, "
        f"or {VARIABLE} names a folder with {data.folder}/{file}"
    )


def get(name: str, *, accept_licence: Consent) -> Path:
    """The folder of a data set; what is not on this machine yet is downloaded into the user's cache.

    Args:
        name: the data set.
        accept_licence: True if the user has seen and accepted :attr:`DataSet.terms`; or a function that shows
            them and asks. Only asked when there is something to download.

    Raises:
        InputError: no such set.
        LogError: the licence was not accepted, the network does not answer, or what came is not what was published.
        MissingExtraError: something must be downloaded and ``palpate[data]`` is not installed.
    """
    here = path(name)
    if here is not None:
        return here
    data = data_set(name)
    try:
        import pooch
    except ImportError:
        raise MissingExtraError("data", f"downloading data set {name!r}") from None
    accepted = accept_licence(data.terms) if callable(accept_licence) else accept_licence
    if not accepted:
        raise LogError(
            f"data set {name!r} was not downloaded: its licence ({data.licence_name}) was not accepted"
        )
    pooch.get_logger().setLevel("WARNING")  # it tells every file otherwise
    folder = _cache(pooch, data)
    for file in data.files:
        url = data.url(file)
        try:
            pooch.retrieve(url, f"sha256:{file.sha256}", fname=file.name, path=folder)
        except ValueError as error:  # pooch's word for a wrong hash
            raise LogError(
                f"{url} is not the file that was published: {str(error).splitlines()[0]}"
            ) from error
        except OSError as error:  # no network, no such address, no space
            told = str(error)  # of a dead network requests tells its whole pool
            reason = told if told and len(told) <= 200 else type(error).__name__
            raise LogError(
                f"{url} cannot be downloaded ({reason}). Without a network, put the files into a folder "
                f"{data.folder} and let {VARIABLE} name the folder above it"
            ) from error
    return folder


def local(folder: str) -> Path | None:
    """A folder that lies beside the data sets (in ``PALPATE_DATA`` or in ``../shared/data``); None: there is none.

    Raises:
        LogError: ``PALPATE_DATA`` is no folder.
    """
    return next((root / folder for root in _roots() if (root / folder).is_dir()), None)


def _roots() -> Iterator[Path]:
    """Folders that hold data sets, but for the user's cache."""
    named = os.environ.get(VARIABLE)
    if named:
        if not Path(named).is_dir():
            raise LogError(f"{VARIABLE} is {named!r}, which is no folder")
        yield Path(named)
        return
    for root in (*_above(Path.cwd()), *_above(Path(__file__).resolve().parent)):
        if (root / "src" / "palpate" / "data.py").is_file():
            yield root.parent / "shared" / "data"


def _folders(data: DataSet) -> Iterator[Path]:
    """Where the set may be, in order."""
    for root in _roots():
        yield root / data.folder
    try:
        import pooch
    except ImportError:
        return  # nothing was ever downloaded
    yield _cache(pooch, data)


def _above(folder: Path) -> tuple[Path, ...]:
    return (folder, *folder.parents)


def _cache(pooch: object, data: DataSet) -> Path:
    # one folder per commit: an update of the registry must not meet old files
    return Path(pooch.os_cache("palpate")) / "data" / f"{data.folder}-{data.commit[:12]}"  # type: ignore[attr-defined]


def _check(place: Path, file: DataFile) -> None:
    try:
        status = place.stat()
        found = _sha256(str(place), status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise LogError(f"{place}: cannot be read: {error.strerror or error}") from error
    if found != file.sha256:
        raise LogError(
            f"{place} is not the published file: its SHA-256 is {found[:16]}..., expected {file.sha256[:16]}..."
        )


@lru_cache(maxsize=256)
def _sha256(place: str, size: int, changed_ns: int) -> str:
    """Of a file; size and time of change only tell the cache that it is still the same."""
    with open(place, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()

"""rosbag2's SQLite storage (``.db3``), with Python's own sqlite3."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from palpate.errors import LogError
from palpate.logs.mcap import Channel, Message
from palpate.logs.messages import Definition

# schema 4, written by rosbag2 from Iron on and read by all since Foxy
_SCHEMA = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'palpate');
"""


class Db3Reader:
    """Messages of a ``.db3`` file in the order they were written.

    Attributes:
        problems: sentences about damage found so far; empty for a sound file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []

    def messages(self) -> Iterator[Message]:
        """Iterate over the messages.

        Raises:
            LogError: not a rosbag2 database.
        """
        leftovers = [Path(f"{self.path}-{end}") for end in ("journal", "wal")]
        with tempfile.TemporaryDirectory() as folder:
            path, mode = self.path, "immutable=1"
            if any(rest.exists() and rest.stat().st_size for rest in leftovers):
                # a killed writer's journal must be played back, which changes the file: do it on a copy
                self.problems.append("the recording was interrupted")
                path, mode = Path(folder, "copy.db3"), "mode=rw"
                shutil.copyfile(self.path, path)
                for rest in leftovers:
                    if rest.exists():
                        shutil.copyfile(rest, str(path) + str(rest)[len(str(self.path)) :])
            yield from self._messages(path, mode)

    def _messages(self, path: Path, mode: str) -> Iterator[Message]:
        count = 0
        try:
            with closing(sqlite3.connect(f"{path.resolve().as_uri()}?{mode}", uri=True)) as database:
                database.execute("PRAGMA trusted_schema = OFF")
                # text damaged by flipped bits must not raise
                database.text_factory = lambda raw: raw.decode("utf-8", "replace")
                tables = {
                    name
                    for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
                }
                if not {"topics", "messages"} <= tables:
                    raise LogError(f"{self.path}: no rosbag2 database: it has no tables topics and messages")
                channels = {
                    number: Channel(str(topic), str(type_name), str(encoding))
                    for number, topic, type_name, encoding in database.execute(
                        "SELECT id, name, type, serialization_format FROM topics"
                    )
                }
                for number, time_ns, data in database.execute(
                    "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
                ):
                    if number in channels and isinstance(time_ns, int) and isinstance(data, bytes):
                        count += 1
                        yield Message(channels[number], time_ns, data)
                    elif len(self.problems) < 8:
                        self.problems.append(f"message {count + 1} is damaged")
        except (sqlite3.Error, OverflowError, UnicodeDecodeError, MemoryError) as error:
            if count == 0:
                raise LogError(f"{self.path}: not a readable rosbag2 database: {error}") from None
            self.problems.append(f"damaged behind message {count}: {error}")


class Db3Writer:
    """Writes a ``.db3`` file; what was flushed survives the death of the process.

    Args:
        path: file to create.
        overwrite: replace an existing file.
    """

    storage = "sqlite3"

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        if overwrite:
            path.unlink(missing_ok=True)
        elif path.exists():
            raise FileExistsError(17, "file exists", str(path))
        self.path = path
        self.topics: list[tuple[str, str, Definition]] = []
        self.counts: list[int] = []
        self.span: tuple[int, int] | None = None  #: earliest and latest log time [ns]
        self._types: set[str] = set()
        self._pending: list[tuple[int, int, bytes]] = []
        self._database = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        # waiting for the disk would stall a control loop; only a crash of the whole machine can cost data
        self._database.execute("PRAGMA synchronous = OFF")
        self._database.executescript(_SCHEMA)

    def add_channel(self, topic: str, type_name: str, definition: Definition) -> int:
        """Announce a topic; returns its number for ``write``."""
        if type_name not in self._types:
            self._types.add(type_name)
            self._database.execute(
                "INSERT INTO message_definitions VALUES (NULL, ?, 'ros2msg', ?, ?)",
                (type_name, definition.text, definition.hash),
            )
        number = len(self.topics)
        self._database.execute(
            "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '', ?)",
            (number + 1, topic, type_name, definition.hash),
        )
        self.topics.append((topic, type_name, definition))
        self.counts.append(0)
        return number

    def write(self, channel: int, time_ns: int, data: bytes) -> None:
        """Append a message; it reaches the operating system with the next ``flush``."""
        first, last = self.span or (time_ns, time_ns)
        self.span = min(first, time_ns), max(last, time_ns)
        self.counts[channel] += 1
        self._pending.append((channel + 1, time_ns, data))
        if len(self._pending) >= 8192:
            self.flush()

    def flush(self) -> None:
        """Write what is pending in one transaction. From then on a killed process does not lose it."""
        if self._pending:
            pending, self._pending = self._pending, []
            try:
                self._database.execute("BEGIN")
                self._database.executemany("INSERT INTO messages VALUES (NULL, ?, ?, ?)", pending)
                self._database.execute("COMMIT")
            except sqlite3.Error as error:
                raise OSError(5, str(error), str(self.path)) from error

    def close(self) -> None:
        """Write the rest."""
        self.flush()
        self._database.close()

    def abandon(self) -> None:
        """Close the file without another byte."""
        self._database.close()

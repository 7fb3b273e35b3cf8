"""ROS 2 over Zenoh: the laws of :mod:`test_ros` once more, the bytes that rmw_zenoh_cpp's design asks for, and peers
that nobody here wrote: zenoh-ros2-sdk (Python) and hiroz (Rust)."""

from __future__ import annotations

import json
import os
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="ROS 2 needs the extra ros")
pytest.importorskip("zenoh", reason="ROS 2 over Zenoh needs the extra ros-zenoh")

import zenoh

import test_ros
import test_ros_peers as peers
from palpate.cli import main
from palpate.errors import InputError
from palpate.logs import Sample
from palpate.ros import (
    LATCHED,
    SENSOR_DATA,
    Context,
    Node,
    Reliability,
    RosArguments,
    SampleSource,
    Subscription,
)
from palpate.ros.graphs import TASKS
from palpate.ros.messages import Float64, Header, InertiaStamped, JointState, KeyValue, Time
from palpate.ros.over_zenoh import _Origin, _Token
from palpate.studies.ros2 import build_zenoh
from ros_here import DOMAIN, here, palpate_ros, until

PORT = 20_000 + os.getpid() % 20_000
ALONE = (
    f'scouting/multicast/enabled=true;scouting/multicast/interface="lo";'
    f'scouting/multicast/address="224.0.0.224:{PORT}";connect/endpoints=[]'
)
"""multicast of this test process alone, and no router"""
JOINT_STATE = (
    "sensor_msgs::msg::dds_::JointState_/"
    "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
)
FLOAT64 = (
    "std_msgs::msg::dds_::Float64_/RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a"
)
GET_PARAMETERS = (
    "rcl_interfaces::srv::dds_::GetParameters_/"
    "RIHS01_bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc"
)
GID = bytes(range(1, 17))
TWO_AND_A_HALF = b"\x00\x01\x00\x00" + struct.pack("<d", 2.5)


def corner(patch: pytest.MonkeyPatch, override: str = ALONE) -> None:
    """A corner of the graph for this test process."""
    patch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    patch.setenv("ZENOH_CONFIG_OVERRIDE", override)
    patch.setenv("ROS_DOMAIN_ID", str(DOMAIN))


@pytest.fixture(autouse=True)
def _corner(monkeypatch: pytest.MonkeyPatch) -> None:
    corner(monkeypatch)


@pytest.fixture
def me() -> Iterator[Node]:
    with here() as there, Node("me", there, quiet=True) as node:
        assert there.rmw == "zenoh"
        yield node


# --- the laws ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="class")
def robot() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        corner(patch)
        made = test_ros._Robot()
        yield made
        made.stop()


class TestSource(test_ros.TestSource):
    pass


class TestGraph(test_ros.TestGraph):
    test_domains = None  # about DDS
    test_what_is_launched = None  # nothing travels


@pytest.mark.usefixtures("robot")
class TestDriver(test_ros.TestDriver):
    pass


class TestDriverAlone(test_ros.TestDriverAlone):
    pass


class TestTasks(test_ros.TestTasks):
    pass


class TestWeighing:
    test_the_graph_weighs_as_one_process_does = (
        test_ros.TestProcesses.test_the_graph_weighs_as_one_process_does
    )


@pytest.mark.slow
class TestProcesses(test_ros.TestProcesses):
    test_the_graph_weighs_as_one_process_does = None  # above
    test_a_node_that_fails_ends_the_launch = None  # nothing travels


@pytest.mark.slow
class TestBoard(test_ros.TestBoard):
    test_nonsense_is_refused = None  # nothing travels


@pytest.mark.slow
class TestCommands(test_ros.TestCommands):
    test_wrong_input = None  # nothing travels


# --- the wire ----------------------------------------------------------------------------------------------------


@pytest.fixture
def session() -> Iterator[Any]:
    """A bare session of Zenoh in the same corner, which knows nothing of ROS."""
    config = zenoh.Config()
    for pair in ALONE.split(";"):
        config.insert_json5(*pair.split("=", 1))
    with zenoh.open(config) as made:
        yield made


def beside(sequence: int, gid: bytes = GID) -> bytes:
    """What stands beside a message: its number, when it was written, the length of an identity, the identity."""
    return struct.pack("<qq", sequence, 7_000_000_001) + b"\x10" + gid


@contextmanager
def mouth(session: Any, me: Node, reading: Subscription) -> Iterator[Any]:
    """A bare publisher of /x with its token; both ends know each other."""
    token = f"@ros2_lv/{DOMAIN}/5e/0/1/MP/%/%/mouth/%x/{FLOAT64}/::,10:,:,:,,"
    with session.liveliness().declare_token(token), session.declare_publisher(f"{DOMAIN}/x/{FLOAT64}") as out:
        until([me], lambda: reading.writers and out.matching_status.matching, "a match")
        yield out


class TestWire:
    """Keys and bytes written out here, against what palpate sends and takes."""

    def test_what_is_sent(self, me: Node, session: Any) -> None:
        heard: list[Any] = []
        out = me.publish(JointState, "/arm/joint_states")
        hearing = session.declare_subscriber(f"{DOMAIN}/arm/joint_states/{JOINT_STATE}", heard.append)
        token = f"@ros2_lv/{DOMAIN}/5e/0/1/MS/%/%lab/ear/%arm%joint_states/{JOINT_STATE}/::,10:,:,:,,"
        telling = session.liveliness().declare_token(token)
        until([me], lambda: out.readers, "the reader")
        (end,) = me.context.subscribers("/arm/joint_states")
        assert (end.node, end.type, end.reliable) == ("/lab/ear", "sensor_msgs/msg/JointState", True)
        for k in range(2):
            out.publish(JointState(Header(Time(3, k)), ["a"], [1.0]))
        until([me], lambda: len(heard) == 2, "what was sent")
        for k, sample in enumerate(heard):
            assert sample.payload.to_bytes() == (
                b"\x00\x01\x00\x00\x03\x00\x00\x00" + struct.pack("<I", k) + b"\x01\x00\x00\x00\x00"
                b"\x00\x00\x00\x01\x00\x00\x00\x02\x00\x00\x00a\x00\x00\x00"
                b"\x01\x00\x00\x00" + struct.pack("<d", 1.0) + bytes(8)
            )
            raw = sample.attachment.to_bytes()
            assert len(raw) == 33 and raw[16] == 16 and raw[17:] == heard[0].attachment.to_bytes()[17:]
            number, written = struct.unpack_from("<qq", raw)
            assert number == k + 1 and written > 1_600_000_000_000_000_000
        telling.undeclare()
        until([me], lambda: not out.readers, "its leaving")
        hearing.undeclare()

    def test_what_the_graph_tells(self, me: Node, session: Any) -> None:
        me.publish(Float64, "/latched", LATCHED)
        me.subscribe(Float64, "fast", lambda m, w: None, SENSOR_DATA)
        found: list[str] = []
        session.liveliness().declare_subscriber(
            f"@ros2_lv/{DOMAIN}/**", lambda s: found.append(str(s.key_expr)), history=True
        )
        zid = me.context.transport.session.zid()  # type: ignore[attr-defined]
        names = f"@ros2_lv/{DOMAIN}/{zid}/0/"
        wanted = [
            (f"{names}0/NN/%/%/me", ""),
            ("/MP/%/%/me", f"/%latched/{FLOAT64}/:1:,1:,:,:,,"),
            ("/MS/%/%/me", f"/%fast/{FLOAT64}/2::,5:,:,:,,"),
            ("/SS/%/%/me", f"/%me%get_parameters/{GET_PARAMETERS}/::,10:,:,:,,"),
        ]

        def told(kind: str, end: str) -> bool:
            return any(key.startswith(names) and key.endswith(kind + end) for key in found)

        until([me], lambda: all(told(*each) for each in wanted), "the tokens")

    def test_a_part_of_messages_is_none(self, me: Node) -> None:
        with pytest.raises(InputError, match="/x: diagnostic_msgs/msg/KeyValue is a part"):
            me.publish(KeyValue, "/x")

    def test_what_is_taken(self, me: Node, session: Any) -> None:
        got: list[tuple[float, int]] = []
        taking = me.subscribe(Float64, "/x", lambda m, w: got.append((m.data, w)))
        with mouth(session, me, taking) as out:
            out.put(TWO_AND_A_HALF, attachment=beside(1))
            until([me], lambda: got, "a number")
            assert got[0][0] == 2.5 and taking.alive(got[0][1]) and not taking.alive(5)
            out.delete()
            for attachment in (None, b"", beside(2)[:-1], beside(2) + b"x", bytes(33)):
                before = taking.malformed
                out.put(TWO_AND_A_HALF, attachment=attachment)
                until([me], lambda before=before: taking.malformed > before, "a refusal")
            out.put(b"\x00\x01\x00\x00", attachment=beside(3))
            until([me], lambda: taking.malformed == 6, "a refusal")
            until([me], lambda: me.troubles, "the complaint")
            assert "some messages are not std_msgs/msg/Float64" in me.troubles[0] and len(got) == 1
        until([me], lambda: not taking.writers, "its leaving")
        assert not taking.alive(got[0][1])

    def test_what_is_missing_is_counted(self, me: Node, session: Any) -> None:
        """By the numbers of the messages, each writer's for itself; and what came faster than it was taken."""
        got: list[float] = []
        taking = me.subscribe(Float64, "/x", lambda m, w: got.append(m.data), Reliability(depth=4))
        numbers = [(7, GID), (8, GID), (12, GID), (3, GID[::-1]), (5, GID[::-1]), (13, GID)]
        with mouth(session, me, taking) as out:
            for count, (number, gid) in enumerate(numbers, 1):
                out.put(TWO_AND_A_HALF, attachment=beside(number, gid))
                until([me], lambda count=count: len(got) == count, "a number")
            assert taking.missed == 4
            until([me], lambda: me._facts.get("missed") == "4", "the diagnostics")
            for number in range(14, 24):
                out.put(TWO_AND_A_HALF, attachment=beside(number))
            until([me], lambda: len(got) + taking.missed == 20, "the rest")

    def test_what_is_asked(self, me: Node, session: Any) -> None:
        """``ros2 param get`` byte by byte, and questions that are none."""
        key = f"{DOMAIN}/me/get_parameters/{GET_PARAMETERS}"
        question = b"\x00\x01\x00\x00\x01\x00\x00\x00\x0d\x00\x00\x00use_sim_time\x00"
        replies: list[Any] = []

        asker = session.declare_querier(key, timeout=100.0)

        def ask(payload: bytes, attachment: bytes | None) -> Any:
            replies.clear()
            asker.get(replies.append, payload=payload, attachment=attachment)
            until([me], lambda: replies, "an answer")
            return replies[0]

        until([me], lambda: asker.matching_status.matching, "the service")
        answer = ask(question, beside(41))
        # one value: of type bool, false; a number of each kind; and empty arrays
        assert answer.ok.payload.to_bytes()[:10] == b"\x00\x01\x00\x00\x01\x00\x00\x00\x01\x00"
        raw = answer.ok.attachment.to_bytes()
        assert struct.unpack_from("<q", raw) == (41,) and raw[16:] == b"\x10" + GID
        for payload, attachment in ((question, None), (question[:12], beside(1)), (b"", beside(1))):
            refusal = ask(payload, attachment)
            assert refusal.ok is None and "GetParameters_Request" in refusal.err.payload.to_string()

    def test_giants_and_noise_are_refused_without_growth(self, session: Any, tmp_path: Path) -> None:
        """A name of 1 MB, 100 000 numbers, a length that lies, over and over: good messages go on, memory stays."""
        arm = [f"A{k}" for k in range(1, 8)]

        def packed(names: list[str], numbers: int) -> bytes:
            message: Any = JointState(Header(Time(9, 0)), names, [0.0] * numbers, [], [0.0] * numbers)
            return bytes(message.serialize(use_version_2=False))

        lie = b"\x00\x01\x00\x00" + bytes(8) + b"\x01\x00\x00\x00\x00\x00\x00\x00" + b"\xff" * 4 + bytes(64)
        bad = [packed(["x" * 1_000_000, *arm[1:]], 7), packed(arm, 100_000), lie, os.urandom(30_000)]
        key = f"{DOMAIN}/joint_states/{JOINT_STATE}"
        for text in ("x", "5e/0/1/MP/%/%/n", "5e/0/1/MP/%/%/n/%t/a/b/c", "5e/0/1/NN/%/%"):
            session.liveliness().declare_token(f"@ros2_lv/{DOMAIN}/{text}")
        token = session.liveliness().declare_token(
            f"@ros2_lv/{DOMAIN}/5e/0/1/MP/%/%/giant/%joint_states/{JOINT_STATE}/::,10:,:,:,,"
        )
        answers: list[InertiaStamped] = []
        said = tmp_path / "said"
        options = ["--ros-args", "-p", "arm:=kuka_lbr_iiwa7", "-p", "assume:=true"]
        with here() as there, Node("me", there, quiet=True) as me, said.open("w") as output:
            me.subscribe(InertiaStamped, "/payload", lambda m, w: answers.append(m))
            node = palpate_ros("run", "mass", *options, stdout=output)
            sent = 0

            def answered(count: int) -> bool:
                nonlocal sent
                for payload in (packed(arm, 7), *bad):
                    sent += 1
                    session.put(key, payload, attachment=beside(sent))
                me.spin_once(0.05)
                return len(answers) > count

            try:
                until([me], lambda: "/mass" in there.nodes(), "the node")
                until([me], lambda: answered(0), "the first answer")
                status = Path(f"/proc/{node.pid}/status")
                before = peers._peak(status)
                complaint = "some messages are not"
                until([me], lambda: answered(60) and complaint in said.read_text(), "more answers")
                assert node.poll() is None
                assert peers._peak(status) - before < 20_000, "a hundred MB were thrown at it"
            finally:
                node.terminate()
                node.wait(60)
        token.undeclare()
        assert "Traceback" not in said.read_text()

    @given(st.text(alphabet="@ros2_lv/%:,NMPS0a", max_size=80), st.binary(max_size=40))
    def test_any_token_and_attachment_is_one_or_none(self, key: str, raw: bytes) -> None:
        token = _Token.parse(f"@ros2_lv/1/{key}")
        assert token is None or token.node.startswith("/") or "/" in token.node
        origin = _Origin.parse(zenoh.ZBytes(raw))
        assert (origin is not None) == (len(raw) == 33 and raw[16] == 16 and any(raw[17:]))
        assert origin is None or origin.pack() == raw


class TestSettings:
    def test_who_is_asked_for(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with Context(DOMAIN, rmw="dds", localhost=True) as there:
            assert there.rmw == "dds", "an argument beats the environment"
        monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
        with Context(DOMAIN, localhost=True) as there:
            assert there.rmw == "dds"
        with Context(DOMAIN, rmw="zenoh") as there:
            assert there.rmw == "zenoh"
        with pytest.raises(InputError, match="no rmw 'zeno'.*zenoh"):
            Context(rmw="zeno")  # type: ignore[arg-type]

    @pytest.mark.parametrize(
        ("name", "value", "words"),
        [
            ("ZENOH_CONFIG_OVERRIDE", "scouting", "expected key=value"),
            ("ZENOH_CONFIG_OVERRIDE", "no/such/key=1", "no/such/key"),
            ("ZENOH_CONFIG_OVERRIDE", "mode=nonsense", "mode"),
            ("ZENOH_CONFIG_OVERRIDE", 'listen/endpoints=["tcp/256.0.0.1:1"]', "does not start"),
            ("ZENOH_SESSION_CONFIG_URI", "/nowhere.json5", "nowhere"),
        ],
    )
    def test_mistakes_are_named(
        self,
        name: str,
        value: str,
        words: str,
        monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.setenv(name, value)
        assert main(["ros", "list", "--wait", "0"]) == 2
        error = capfd.readouterr().err
        assert words in error and name in error and error.count("\n") == 1

    def test_a_file_of_settings(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        file = tmp_path / "session.json5"
        file.write_text('{mode: "peer", listen: {endpoints: ["tcp/127.0.0.1:0"]}}')
        monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(file))
        with here() as one, here() as two, Node("one", one, quiet=True) as me:
            until([me], lambda: "/one" in two.nodes(), "the other")

    def test_a_router_brings_nodes_together(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """As ROS has it: no multicast, all know the router's port alone."""
        config = zenoh.Config()
        for key, value in (
            ("mode", '"router"'),
            ("listen/endpoints", '["tcp/127.0.0.1:0"]'),
            ("scouting/multicast/enabled", "false"),
            ("adminspace/enabled", "true"),
        ):
            config.insert_json5(key, value)
        with zenoh.open(config) as router:
            (told,) = router.get(f"@/{router.zid()}/router")
            (port,) = json.loads(told.ok.payload.to_string())["locators"]
            corner(monkeypatch, f'scouting/multicast/enabled=false;connect/endpoints=["{port}"]')
            got: list[float] = []
            with (
                here() as one,
                here() as two,
                Node("one", one, quiet=True) as a,
                Node("two", two, quiet=True) as b,
            ):
                out = a.publish(Float64, "x")
                reading = b.subscribe(Float64, "x", lambda m, w: got.append(m.data))
                until([a, b], lambda: out.readers and reading.writers, "a match")
                # the way past the router may still be making
                until([a, b], lambda: (out.publish(Float64(3.0)), got)[1], "a message")

    def test_where_nobody_is(self, me: Node, capfd: pytest.CaptureFixture[str]) -> None:
        assert main(["ros", "list", "--wait", "0", "--domain", "101", "--rmw", "zenoh"]) == 0
        assert "no nodes: is it another domain" in capfd.readouterr().out
        assert "no Zenoh router at tcp/localhost:7447" in me.context.transport.alone()
        with here():
            until([me], lambda: not me.context.transport.alone(), "a peer")

    def test_what_is_missing_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        import sys

        from palpate.errors import MissingExtraError

        monkeypatch.delitem(sys.modules, "palpate.ros.over_zenoh")
        monkeypatch.setitem(sys.modules, "zenoh", None)
        import palpate.ros

        monkeypatch.delattr(palpate.ros, "over_zenoh")
        with pytest.raises(MissingExtraError, match="ros-zenoh"):
            here()


# --- peers -------------------------------------------------------------------------------------------------------


class TestSdk:
    """zenoh-ros2-sdk, which knows types by their definitions and computes the hashes itself."""

    @pytest.fixture
    def sdk(self) -> Iterator[Any]:
        sdk = pytest.importorskip("zenoh_ros2_sdk", reason="the peer zenoh-ros2-sdk is not installed")
        from zenoh_ros2_sdk.session import ZenohSession

        yield sdk
        ZenohSession.get_instance().close()

    def test_there_and_back(self, me: Node, sdk: Any) -> None:
        got: list[float] = []
        theirs: list[float] = []
        options = {"msg_definition": "float64 data", "domain_id": DOMAIN, "namespace": "/lab"}
        speaker = sdk.ROS2Publisher("/x", "std_msgs/msg/Float64", node_name="mouth", **options)
        ear = sdk.ROS2Subscriber(
            "/y", "std_msgs/msg/Float64", lambda m: theirs.append(m.data), node_name="ear", **options
        )
        reading = me.subscribe(Float64, "/x", lambda m, w: got.append(m.data))
        out = me.publish(Float64, "/y")
        until([me], lambda: reading.writers and out.readers, "a match")
        until([me], lambda: speaker.pub.matching_status.matching, "its knowing of the reader")
        assert [e.node for e in me.context.publishers("/x")] == ["/lab/mouth"]
        until([me], lambda: me.context.nodes() == ["/lab/ear", "/lab/mouth", "/me"], "their names")
        for k in range(50):
            speaker.publish(data=float(k))
            out.publish(Float64(float(k)))
        until([me], lambda: len(got) == len(theirs) == 50, "all messages")
        assert got == theirs == list(range(50))
        speaker.close()
        ear.close()
        until([me], lambda: me.context.nodes() == ["/me"], "their leaving")

    def test_a_service(self, me: Node, sdk: Any) -> None:
        client = sdk.ROS2ServiceClient(
            "/me/get_parameter_types",
            "rcl_interfaces/srv/GetParameterTypes",
            request_definition="string[] names",
            response_definition="uint8[] types",
            domain_id=DOMAIN,
            timeout=3.0,
        )
        answers: list[Any] = []

        def ask() -> None:
            for _ in range(30):  # it does not wait for the service, and nobody is known at first
                answer = client.call(names=["use_sim_time"])
                if answer is not None:
                    answers.append(answer)
                    return

        asking = threading.Thread(target=ask)
        asking.start()
        until([me], lambda: not asking.is_alive(), "an answer")
        assert list(answers[0].types) == [1]
        client.close()


@pytest.fixture(scope="module")
def hiroz() -> Path:
    try:
        return build_zenoh(peers.TREE, peers.TREE / "build" / "peers" / "zenoh")
    except InputError as missing:
        pytest.skip(str(missing))


@pytest.mark.slow
class TestHiroz:
    """A peer in a process of its own, by the makers of Zenoh."""

    def test_there_and_back_without_loss(self, hiroz: Path, me: Node) -> None:
        got: list[JointState] = []
        with peers.running(hiroz, "echo", str(DOMAIN), peers.TOPIC):
            out = me.publish(JointState, peers.TOPIC)
            back = me.subscribe(JointState, f"{peers.TOPIC}_echo", lambda m, w: got.append(m))
            until([me], lambda: out.readers and back.writers, "a match")
            peers.there_and_back(me, out, got)
        until([me], lambda: me.context.nodes() == ["/me"], "its leaving")
        assert not out.readers and not back.writers

    def test_a_best_effort_robot_with_joints_in_another_order(self, hiroz: Path, me: Node) -> None:
        got: list[Sample] = []
        with peers.running(hiroz, "robot", str(DOMAIN), peers.TOPIC):
            SampleSource(me, peers.NAMES, peers.TOPIC, lambda s, r: got.append(s))
            until([me], lambda: len(got) >= 5, "samples")
            assert not me.troubles
        for sample in got:
            np.testing.assert_allclose(sample.position, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
            np.testing.assert_array_equal(sample.effort, np.arange(1.0, 8.0))
            assert sample.velocity is None and sample.time_ns >= 100_000_000_000

    def test_giants(self, hiroz: Path, me: Node) -> None:
        got: list[JointState] = []
        with peers.running(hiroz, "giant", str(DOMAIN), peers.TOPIC):
            reading = me.subscribe(JointState, peers.TOPIC, lambda m, w: got.append(m))
            until([me], lambda: len(got) > 20, "good messages")
        assert reading.malformed and all(len(m.position) == 7 for m in got)

    def test_what_is_kept_for_later(self, hiroz: Path, me: Node) -> None:
        got: list[int] = []
        with peers.running(hiroz, "latched", str(DOMAIN), peers.TOPIC) as peer:
            me.subscribe(JointState, peers.TOPIC, lambda m, w: got.append(m.header.stamp.nanosec), LATCHED)
            until([me], lambda: got, "what was sent before")
            assert got[0] == 30_000_000
            out = me.publish(JointState, f"{peers.TOPIC}_too", LATCHED)
            for k in range(1, 4):
                out.publish(JointState(Header(Time(k, 0))))
            until([me], lambda: out.readers, "the reader")
            heard: list[str] = []
            hear = threading.Thread(target=lambda: heard.extend(peer.stdout or ()), daemon=True)
            hear.start()
            until([me], lambda: "kept 3\n" in heard, "the newest")
        hear.join()

    def test_nodes_and_parameters(self, hiroz: Path) -> None:
        """It lists the node's parameters, sets one and reads it back; and finds the node in the graph."""
        arguments = RosArguments.parse(["--ros-args", "-r", "__ns:=/left/arm"])
        with here() as there, TASKS["mass"](there, arguments, quiet=True) as node:
            question = ("params", str(DOMAIN), "/left/arm/mass", "estimator.min_change", "0.02")
            with peers.running(hiroz, *question) as peer:
                until([node], lambda: peer.poll() is not None, "its answers")
                assert peer.stdout is not None
                names, put, wrong, value, kind, meaning = peer.stdout.read().splitlines()
            assert "estimator.min_change" in names.split() and put.split() == ["set", "true"]
            assert wrong == "set false parameter estimator.min_change: expected double, got bool True"
            assert value == "value Double(0.02)" and node.parameters["estimator.min_change"] == 0.02
            assert kind == "type Double" and meaning.startswith("meaning ")
            with peers.running(hiroz, "graph", str(DOMAIN)) as peer:
                lines: list[str] = []
                hear = threading.Thread(target=lambda: lines.extend(peer.stdout or ()), daemon=True)
                hear.start()
                until([node], lambda: "node /left/arm/mass\n" in lines, "its name in the graph")
            hear.join()

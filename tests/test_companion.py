"""The companion loop of examples/companion, against fakes of the flight controllers' side."""

import json
import math
import socket
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "examples" / "companion"))
import core  # noqa: E402

TARGET = np.array([0.0, 0.0, 2.0])


def at_rest(time=0.0, **changes):
    parts = {
        "position": TARGET,
        "quaternion": np.array([1.0, 0.0, 0.0, 0.0]),
        "velocity": np.zeros(3),
        "body_rates": np.zeros(3),
    }
    return core.State(time, **{**parts, **changes})


def turned(axis, degrees):
    half = math.radians(degrees) / 2.0
    return np.append(math.cos(half), math.sin(half) * np.array(axis))


class Clock:
    """Time that passes while the loop sleeps."""

    now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class Link:
    """A flight controller that follows after it was asked, unless ``ours`` says otherwise."""

    def __init__(self, clock, ours=lambda step: True, state=at_rest):
        self.clock, self.ours, self.estimate = clock, ours, state
        self.sent, self.asked, self.handed = [], None, []

    def refusal(self):
        return ""

    def state(self):
        return self.estimate(self.clock())

    def take_over(self):
        self.asked = len(self.sent)

    def is_ours(self):
        return self.asked is not None and self.ours(len(self.sent) - self.asked)

    def send(self, throttle, body_rates):
        self.sent.append((throttle, body_rates))

    def hand_over(self, fault):
        self.handed.append(fault)


class Constant:
    period = 0.01
    resets = 0

    def reset(self):
        self.resets += 1

    def __call__(self, state, target):
        return 1.21, np.array([0.1, 0.2, 0.3])


def run(link, clock, seconds=1.0, policy=None):
    hover = core.HoverThrust(0.5, power=2.0)
    policy = policy or Constant()
    return core.fly(link, policy, hover, TARGET, core.Limits(), seconds, clock, clock.sleep)


def test_it_streams_hover_then_the_policy_and_hands_over():
    clock = Clock()
    link = Link(clock)
    assert run(link, clock) == "" and link.handed == [""]
    assert link.asked == 51
    first, then = link.sent[:51], link.sent[51:]
    assert len(then) == 101
    assert all(throttle == 0.5 and not rates.any() for throttle, rates in first)
    assert then[0] == (pytest.approx(0.55), pytest.approx([0.1, 0.2, 0.3]))
    assert clock.now == pytest.approx(1.52)


@pytest.mark.parametrize(
    ("ours", "state", "fault"),
    [
        (lambda step: step < 30, at_rest, "another mode flies"),
        (lambda step: False, at_rest, "no control after 10 s"),
        (lambda step: True, lambda now: at_rest(min(now, 0.8)), "no state for 0.1 s"),
    ],
)
def test_it_hands_over_once_when_something_is_wrong(ours, state, fault):
    clock = Clock()
    link = Link(clock, ours, state)
    assert run(link, clock, 20.0) == fault and link.handed == [fault]


def test_it_hands_over_when_the_policy_fails_and_sends_nothing_when_it_is_not_ready():
    class Broken(Constant):
        def __call__(self, state, target):
            raise ZeroDivisionError

    clock = Clock()
    link = Link(clock)
    with pytest.raises(ZeroDivisionError):
        run(link, clock, policy=Broken())
    assert link.handed == ["the companion loop failed"]
    link = Link(clock, state=lambda now: None)
    with pytest.raises(RuntimeError, match="no state"):
        run(link, clock)
    assert not link.sent and not link.handed


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"velocity": np.array([0.0, math.nan, 0.0])}, "not finite"),
        ({"quaternion": np.zeros(4)}, "not finite"),
        ({"position": TARGET + np.array([0.0, 0.0, 4.0])}, "height 6.00 m"),
        ({"position": TARGET + np.array([6.0, 0.0, 0.0])}, "too far"),
        ({"body_rates": np.array([0.0, -30.0, 0.0])}, "spins"),
        ({"quaternion": turned([1.0, 0.0, 0.0], 120.0)}, "tilted"),
        ({}, ""),
    ],
)
def test_the_watchdog_names_what_is_wrong(changes, fault):
    watchdog = core.Watchdog(core.Limits())
    assert watchdog.fault(at_rest(), TARGET, 0.0) == ""
    found = [watchdog.fault(at_rest(t, **changes), TARGET, t) for t in np.arange(1, 40) / 100]
    assert fault in found[-1] and bool(found[-1]) == bool(fault)
    # A short tilt is allowed.
    assert (found[20] == "") == (fault in ("", "tilted"))
    assert "late" in watchdog.fault(at_rest(0.5), TARGET, 0.5)


def test_the_throttle_of_hover_is_learnt_in_flight():
    hover = core.HoverThrust(0.45, power=2.0)
    velocity = 0.0
    for step in range(1000):
        throttle = hover.command(1.0 - 0.5 * velocity)
        hover.update(at_rest(0.01 * step, velocity=np.array([0.0, 0.0, velocity])), throttle)
        velocity += 0.01 * core.GRAVITY * ((throttle / 0.5) ** 2 - 1.0)
    assert hover.throttle == pytest.approx(0.5, rel=0.02)
    assert hover.command(5.0) == 1.0 and hover.command(-1.0) == 0.0


def test_the_policy_sees_its_frames_and_keeps_its_state(tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    kinds = onnx.TensorProto.FLOAT
    sizes = {"observation": 18, "state": 2, "command": 4, "next_state": 2}
    info = {
        name: onnx.helper.make_tensor_value_info(name, kinds, [1, size])
        for name, size in sizes.items()
    }
    # Weight and height above the target; forward velocity; a body rate; and how often it was called
    picks = np.zeros((18, 4), np.float32)
    picks[[2, 12, 15], [0, 1, 2]] = 1.0
    values = {"picks": picks, "offset": np.float32([[8, 0, 0, 0]]), "one": np.ones((1, 2))}
    graph = onnx.helper.make_graph(
        [
            onnx.helper.make_node("MatMul", ["observation", "picks"], ["picked"]),
            onnx.helper.make_node("Add", ["picked", "offset"], ["command"]),
            onnx.helper.make_node("Add", ["state", "one"], ["next_state"]),
        ],
        "policy",
        [info["observation"], info["state"]],
        [info["command"], info["next_state"]],
        [onnx.numpy_helper.from_array(np.float32(value), key) for key, value in values.items()],
    )
    opset = [onnx.helper.make_opsetid("", 13)]
    model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=8)
    facts = {
        "period": "0.02 s between calls",
        "vehicle": "a: hover thrust 1 N, kF unknown",
        "observation": "18-20 acceleration of the reference in 5 control steps, turned",
    }
    onnx.helper.set_model_props(model, facts | {"result": "4 numbers: the thrust of each rotor"})
    onnx.save(model, tmp_path / "a.onnx")
    with pytest.raises(ValueError, match="action: rates"):
        core.Policy(str(tmp_path / "a.onnx"))
    onnx.helper.set_model_props(model, facts | {"result": "4 numbers: the collective thrust, N"})
    onnx.save(model, tmp_path / "a.onnx")
    policy = core.Policy(str(tmp_path / "a.onnx"))
    state = at_rest(
        position=TARGET + np.array([0.0, 0.0, 0.4]),
        quaternion=turned([0.0, 0.0, 1.0], 90.0),
        velocity=np.array([0.0, 3.0, 0.0]),
        body_rates=np.array([5.0, 0.0, 0.0]),
    )
    thrust, rates = policy(state, TARGET)
    assert policy.period == 0.02 and policy.preview == [5]
    assert thrust == pytest.approx(2.1) and rates == pytest.approx([3.0, 5.0, 0.0], abs=1e-6)
    policy(state, TARGET)
    assert policy.values[1].tolist() == [[2.0, 2.0]]
    policy.reset()
    assert not policy.values[1].any()


class FakePx4:
    """PX4's end of the line, in PX4's frames and units."""

    target_system = target_component = 1

    def __init__(self, mavlink):
        self.mavlink = mavlink
        self.mav = mavlink.MAVLink(SimpleNamespace(write=self.hear), srcSystem=255)
        self.own = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.decoder = mavlink.MAVLink(None)
        self.inbox, self.heard, self.mode = [], [], 3
        self.takes = {3, 4, 6}

    def hear(self, data):
        message = self.decoder.decode(bytearray(data))
        self.heard.append(message)
        if message.get_type() == "COMMAND_LONG" and message.command == 176:
            self.mode = int(message.param2) if message.param2 in self.takes else self.mode
            self.speak(self.beat())

    def speak(self, *messages):
        for message in messages:
            self.inbox.append(self.decoder.decode(bytearray(message.pack(self.own))))

    def recv_match(self, blocking):
        return self.inbox.pop(0) if self.inbox else None

    def beat(self):
        return self.mavlink.MAVLink_heartbeat_message(2, 12, 128 + 1, self.mode << 16, 4, 3)


@pytest.fixture
def px4():
    pytest.importorskip("pymavlink", reason="pip install '.[companion]'")
    import via_px4

    fake = FakePx4(via_px4.MAV)
    clock = Clock()
    return fake, via_px4.Px4(fake, clock), clock


def test_px4_gets_rates_in_its_frames_and_goes_back_to_position_mode(px4, monkeypatch):
    fake, link, clock = px4
    import via_px4

    monkeypatch.setattr(via_px4.time, "sleep", clock.sleep)
    mavlink = fake.mavlink
    assert link.state() is None and "hold" in link.refusal()
    # North 5 m, east 1 m, up 2 m; the nose 30 degrees up; it sinks, rolls and turns to the right.
    half = math.radians(15.0)
    quaternion = math.cos(half), 0.0, math.sin(half), 0.0
    fake.speak(
        mavlink.MAVLink_attitude_quaternion_message(0, *quaternion, 0.1, 0.2, 0.3),
        mavlink.MAVLink_local_position_ned_message(0, 5.0, 1.0, -2.0, 0.5, 0.0, 0.7),
    )
    fake.speak(fake.beat())
    state = link.state()
    assert state.position == pytest.approx([5.0, -1.0, 2.0])
    assert state.velocity == pytest.approx([0.5, 0.0, -0.7])
    assert state.body_rates == pytest.approx([0.1, -0.2, -0.3])
    assert state.rotation[:, 0] == pytest.approx([math.cos(2 * half), 0.0, math.sin(2 * half)])
    assert "in the air" in link.refusal()
    fake.speak(mavlink.MAVLink_extended_sys_state_message(0, 2))
    assert link.state() and link.refusal() == ""
    link.send(0.6, np.array([0.1, -0.2, -0.3]))
    command = fake.heard[-1]
    assert command.get_type() == "SET_ATTITUDE_TARGET" and command.type_mask == 128
    rates = command.body_roll_rate, command.body_pitch_rate, command.body_yaw_rate
    assert rates == pytest.approx((0.1, 0.2, 0.3)) and command.thrust == pytest.approx(0.6)
    link.take_over()
    assert link.is_ours()
    link.hand_over("")
    assert fake.mode == 3 and not link.is_ours()
    link.take_over()
    assert link.is_ours()
    fake.takes = {4, 6}  # no sticks
    link.hand_over("")
    assert fake.mode == 4


def test_a_crazyflie_gets_degrees_and_its_thrust(monkeypatch):
    pytest.importorskip("cflib.crazyflie", reason="pip install '.[companion]'")
    import via_crazyflie
    from cflib.crazyflie.commander import Commander
    from cflib.crazyflie.log import LogTocElement

    packets, blocks, goals = [], [], []
    cf = SimpleNamespace(send_packet=packets.append)
    cf.commander = Commander(cf)
    cf.high_level_commander = SimpleNamespace(go_to=lambda *place: goals.append(place))
    cf.log = SimpleNamespace(add_config=blocks.append)
    monkeypatch.setattr(via_crazyflie.LogConfig, "start", lambda block: None)
    link = via_crazyflie.Crazyflie(cf, Clock())
    assert link.state() is None and link.refusal()
    sizes = {"float": 4, "FP16": 2, "uint16_t": 2}
    for block in blocks:
        kinds = [LogTocElement.get_cstring_from_id(v.fetch_as) for v in block.variables]
        assert sum(sizes[kind] for kind in kinds) <= 26
    place, attitude = blocks
    place.data_received_cb.call(0, dict(zip(via_crazyflie.PLACE, range(6), strict=True)), place)
    values = dict(zip(via_crazyflie.ATTITUDE, (1.0, 0.0, 0.0, 0.0), strict=True))
    values |= dict(zip(via_crazyflie.GYRO, (180.0, 90.0, 0.0), strict=True))
    attitude.data_received_cb.call(0, values | {via_crazyflie.SUPERVISOR: 16}, attitude)
    state = link.state()
    assert state.velocity.tolist() == [3, 4, 5] and link.refusal() == ""
    assert state.body_rates == pytest.approx([math.pi, math.pi / 2, 0.0])
    link.send(0.5, np.radians([10.0, 20.0, 30.0]))
    kind, roll, pitch, yaw, thrust, is_rate = struct.unpack("<BfffHB", packets[-1].data)
    # cflib turns the pitch to the firmware's axes, in which the nose rises.
    assert (kind, is_rate) == (11, 1) and thrust == pytest.approx(32767, abs=1)
    assert (roll, pitch, yaw) == pytest.approx((10.0, -20.0, 30.0))
    attitude.data_received_cb.call(0, {via_crazyflie.SUPERVISOR: 16 + 32}, attitude)
    assert not link.is_ours()
    link.hand_over("")
    assert packets[-1].channel == 1 and goals[0][:3] == (0, 1, 2)


class FakeBetaflight:
    """Betaflight's end of a serial port."""

    def __init__(self):
        self.active, self.channels, self.out = {0}, None, b""

    def write(self, message):
        from via_betaflight import checksum

        assert message[:3] == b"$M<" and checksum(message[3:-1]) == message[-1]
        code, payload = message[4], message[5:-1]
        modes = [0, 1, 50]
        bits = sum(1 << modes.index(mode) for mode in self.active)
        answers = {119: bytes(modes), 101: struct.pack("<HHHIB", 125, 0, 0, bits, 0), 200: b""}
        if code == 200:
            self.channels = struct.unpack("<4H", payload)
        body = bytes([len(answers[code]), code]) + answers[code]
        self.out = b"$M>" + body + bytes([checksum(body)])

    def read(self, size):
        data, self.out = self.out[:size], self.out[size:]
        return data


def test_betaflight_gets_sticks_and_the_pilot_decides():
    from via_betaflight import FULL_RATE, Betaflight

    fake = FakeBetaflight()
    link = Betaflight(fake, at_rest)
    assert link.refusal() == "" and not link.is_ours()
    fake.active = {0, 50}
    link.look()
    assert link.is_ours() and "override" in link.refusal().lower()
    link.send(0.055, np.zeros(3))
    assert fake.channels == (1500, 1500, 1050, 1500)
    link.send(1.0, FULL_RATE * np.array([1.0, 0.5, 2.0]))
    assert fake.channels == (2000, 1750, 2000, 1000)
    # Silence would leave these sticks for ever.
    link.hand_over("a fault")
    assert fake.channels == (1500, 1500, 1050, 1500)
    fake.active = set()
    assert "armed" in link.refusal()
    fake.read = lambda size: b""
    with pytest.raises(RuntimeError, match="does not answer"):
        link.look()


FAKE_ARDUPILOT = """\
#!{python}
import socket
import struct

end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
end.settimeout(30.0)
for frame in range(10_000):
    pulses = [1600, 1700, 1800, 1900] if frame > 200 else [1000] * 4
    packet = struct.pack("<HHI16H", 18458, 1000, frame, *pulses, *[1000] * 12)
    for _ in range(1 + frame % 2):  # repeated, as when it waits for long
        end.sendto(packet, ("127.0.0.1", {port}))
    with open("seen", "ab") as seen:
        seen.write(end.recv(4096))
"""


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        return end.getsockname()[1]


def test_ardupilot_sees_its_frames_and_drives_the_motors(tmp_path, monkeypatch):
    pytest.importorskip("pymavlink", reason="pip install '.[companion]'")
    import ardupilot_sitl

    from sb3_quad import load_vehicle

    port = free_port()
    monkeypatch.setattr(ardupilot_sitl, "PHYSICS", ("127.0.0.1", port))
    monkeypatch.setattr(ardupilot_sitl, "LINK", f"127.0.0.1:{free_port()}")
    program = tmp_path / "arducopter"
    program.write_text(FAKE_ARDUPILOT.format(python=sys.executable, port=port))
    program.chmod(0o755)
    values = ardupilot_sitl.parameters(load_vehicle(ROOT / "examples" / "five_inch.yaml"))
    sitl = ardupilot_sitl.ArduPilot(program, values)
    try:
        assert sitl.time > 0.2  # it asked until the motors turned
        sitl.velocity = np.zeros(3)
        rolled = turned([1.0, 0.0, 0.0], 90.0)  # its left side is up
        moves = {"velocity": np.array([0.001, 0.002, 0.003]), "body_rates": np.array([1, 2, 3])}
        motors = sitl.step(at_rest(quaternion=rolled, **moves))
        np.testing.assert_allclose(motors, [0.6, 0.7, 0.8, 0.9])
        line = (sitl.folder / "seen").read_text().strip().splitlines()[-1]
    finally:
        sitl.close()
    assert not sitl.folder.exists()
    seen = json.loads(line)
    assert seen["gyro"] == [1.0, -2.0, -3.0]
    assert seen["position"] == [0.0, -0.0, -2.0]
    assert seen["velocity"] == [0.001, -0.002, -0.003]
    np.testing.assert_allclose(seen["quaternion"], rolled)
    # Gravity is felt to the left, 1 m/s² forward, as 3 m/s² up, and 2 m/s² that are now down.
    np.testing.assert_allclose(seen["accel_body"], [1.0, -(core.GRAVITY + 3.0), 2.0], atol=1e-9)

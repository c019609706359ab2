"""The MELFA controller as its wire shows it, byte for byte."""

from dataclasses import replace

import numpy as np
import pytest

from simulators.robots.melfa import MelfaRobot, MelfaSession
from simulators.world.truth import stream
from simulators.world.world_file import WorldFile


class Client:
    """Sends lines and waits for the answers."""

    def __init__(self, session: MelfaSession) -> None:
        self.session, self.time_s = session, 0.0

    def ask(self, command: str, within_s: float = 5.0) -> bytes:
        self.session.receive(f"1;1;{command}\r".encode(), self.time_s)
        self.time_s = self.session.next_output_s()
        return self.session.take(self.time_s)

    def ready(self) -> "Client":
        for command in ("OPEN=TEST", "CNTLON", "SRVON"):
            assert self.ask(command).startswith(b"QoK")
        self.time_s += 1.0
        return self


@pytest.fixture
def robot(world_file: WorldFile) -> MelfaRobot:
    return MelfaRobot(world_file.arm, stream(1, "test"), np.zeros(6))


@pytest.fixture
def client(robot: MelfaRobot) -> Client:
    return Client(MelfaSession(robot)).ready()


def test_state_by_its_bytes(robot: MelfaRobot) -> None:
    session = MelfaSession(robot)
    for byte in bytes.fromhex("313B313B53544154450D"):  # 1;1;STATE<CR>, one byte at a time
        session.receive(bytes((byte,)), 0.0)
    assert session.take(1.0) == b"QoKTRUECELL.MB5;1;100;1;01100;1;1;;;;;;;;;REP;START;1;0\r"


def test_run_bits_follow_the_motion_not_the_acceptance(client: Client) -> None:
    assert client.ask("DSTATE") == b"QoKA1100;1;1\r"  # servo on, right held
    assert client.ask("EXECJ1=(10.0,0.0,-90.0,0.0,-90.0,0.0)") == b"QoK\r"
    assert client.ask("EXECJOVRD 50.0") == b"QoK\r"
    assert client.ask("EXECMOV J1") == b"QoK\r"
    assert client.ask("DSTATE") == b"QoKA1100;1;1\r"  # accepted, not begun
    client.time_s += 0.05
    assert client.ask("DSTATE") == b"QoKE1100;1;1\r"
    assert client.ask("EXECMOV J1") == b"QeR5640\r"
    client.time_s += 2.0
    assert client.ask("JPOSF") == (
        b"QoKJ1;10.00;J2;0.00;J3;-90.00;J4;0.00;J5;-90.00;J6;0.00;;****,****;100;0.00;00000000\r"
    )


def test_exec2_answers_when_the_move_has_ended(robot: MelfaRobot, client: Client) -> None:
    client.ask("EXECJ1=(30.0,0.0,-90.0,0.0,-90.0,0.0)")
    before_s = client.time_s
    assert client.ask("EXEC2=MOV J1") == b"QoK\r"
    assert client.time_s - before_s > 0.4 and not robot.moving(client.time_s)


def test_a_linear_move_leads_straight_to_the_pose_that_it_reports(robot: MelfaRobot, client: Client) -> None:
    start = robot.pose_of(robot.joints_at(client.time_s))
    x, y, z = start[:3, 3] * 1e3
    fields = client.ask("PPOSF")[3:].split(b";")
    angles = ",".join(fields[i].decode() for i in (7, 9, 11))
    client.ask(f"EXECP1=({x + 40:.3f},{y:.3f},{z - 30:.3f},{angles})")
    client.ask("EXECSPD 50.00")
    assert client.ask("EXECMVS P1") == b"QoK\r"
    begin_s, end_s = client.time_s, robot.end_s()
    assert end_s - begin_s == pytest.approx(1.0, abs=0.15)  # 50 mm at 50 mm/s
    way = np.array([0.04, 0.0, -0.03])
    for time_s in np.linspace(begin_s, end_s, 7):
        moved = robot.pose_of(robot.joints_at(float(time_s)))[:3, 3] - start[:3, 3]
        along = moved @ way / (way @ way)
        assert np.linalg.norm(moved - along * way) < 1e-5
    assert robot.pose_of(robot.joints_at(end_s))[:3, 3] == pytest.approx(start[:3, 3] + way, abs=1e-6)


def test_refusals(robot: MelfaRobot, client: Client) -> None:
    stranger = Client(MelfaSession(robot))
    stranger.time_s = client.time_s
    assert stranger.ask("EXECMOV J1") == b"QeR6020\r"  # no operation right
    assert stranger.ask("CNTLON") == b"QeR6020\r"  # somebody has it
    assert client.ask("NONSENSE") == b"QeR4000\r"
    assert client.ask("EXECMOV J9") == b"QeR4220\r"
    assert client.ask("OVRD=0") == b"QeR4000\r"
    client.ask("EXECJ1=(0.0,150.0,0.0,0.0,0.0,0.0)")
    assert client.ask("EXECMOV J1") == b"Qer2602\r"  # and an error that stays
    assert client.ask("ERROR") == b"Qok2602;2\r"
    client.ask("EXECJ1=(1.0,0.0,-90.0,0.0,-90.0,0.0)")
    assert client.ask("EXECMOV J1") == b"Qer5600\r"
    assert client.ask("RSTALRM") == b"QoK\r"
    assert client.ask("EXECMOV J1") == b"QoK\r"


def test_anybody_may_stop_and_the_program_must_be_reset_then(robot: MelfaRobot, client: Client) -> None:
    client.ask("EXECJ1=(90.0,0.0,-90.0,0.0,-90.0,0.0)")
    client.ask("EXECMOV J1")
    client.time_s += 0.5
    stranger = Client(MelfaSession(robot))
    stranger.time_s = client.time_s
    assert stranger.ask("STOP") == b"QoK\r"
    assert robot.end_s() < stranger.time_s + 0.2
    client.time_s = stranger.time_s + 1.0
    assert client.ask("EXECMOV J1") == b"QeR5610\r"
    assert client.ask("RSTPRG") == b"QoK\r"
    assert client.ask("EXECMOV J1") == b"QoK\r"


def test_who_asks_too_soon_while_it_runs_waits(client: Client) -> None:
    client.ask("EXECJ1=(90.0,0.0,-90.0,0.0,-90.0,0.0)")
    client.ask("EXECMOV J1")
    times = [client.time_s]
    for _ in range(4):
        client.ask("DSTATE")
        times.append(client.time_s)
    assert np.diff(times).min() > 0.1


def test_a_serial_line_takes_its_time(world_file: WorldFile) -> None:
    robot = MelfaRobot(world_file.arm, stream(1, "test"), np.zeros(6))
    robot.settings = replace(robot.settings, baud=9600)
    client = Client(MelfaSession(robot))
    answer = client.ask("JPOSF")
    assert client.time_s == pytest.approx((10 + len(answer)) * 12 / 9600 + 0.008, abs=1e-9)


def test_an_emergency_stop_takes_the_servo_and_stays_until_reset(robot: MelfaRobot, client: Client) -> None:
    robot.permit(False, client.time_s)
    assert client.ask("DSTATE") == b"Qok811150;1;1\r"
    assert client.ask("RSTALRM") == b"Qok\r"  # still pressed
    robot.permit(True, client.time_s)
    assert client.ask("RSTALRM") == b"QoK\r"
    assert client.ask("EXECMOV J1") == b"QeR2000\r"  # servo off

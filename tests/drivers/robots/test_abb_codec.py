"""Requests and replies of the open_abb server, by their characters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.robots import abb_codec as codec
from estimation.errors import DeviceError, FrameError

JOINTS = codec.joint_decimals(2)


def test_requests_as_the_server_program_reads_them() -> None:
    assert codec.encode(codec.POSE) == b"03 #"
    assert codec.encode(codec.JOINTS) == b"04 #"
    assert codec.encode(codec.CLOSE) == b"99 #"
    assert codec.encode(codec.MOVE_JOINTS, [10, -20.5, 30, 0, 90, -179.9999]) == (
        b"02 10.0000 -20.5000 30.0000 0.0000 90.0000 -179.9999 #"
    )
    assert codec.encode(codec.SPEED, [100, 50]) == b"08 100.0000 50.0000 #"
    assert codec.encode(codec.ZONE, codec.FINE) == b"09 1.0000 0.0000 0.0000 0.0000 #"


def test_the_longest_move_fits_into_a_string_of_the_program() -> None:
    longest = codec.encode(codec.MOVE_LINEAR, [-1234.5678] * 3 + [-0.1234] * 4)
    assert len(longest) <= codec.MOST_BYTES
    with pytest.raises(DeviceError, match="request of 125 bytes, limit 80"):
        codec.encode(codec.MOVE_LINEAR, [-1234.5678] * 11)


def test_replies_have_no_end_so_every_value_is_counted() -> None:
    """Cut anywhere, a reply is incomplete; with 2 decimals expected, 12.3 is not taken for 12.34."""
    reply = b"4 1 12.34 -20.50 30.00 0.00 90.00 -179.99"
    for cut in range(len(reply)):
        assert codec.parse_reply(reply[:cut], codec.JOINTS, JOINTS) is None
    assert codec.parse_reply(reply, codec.JOINTS, JOINTS) == [12.34, -20.5, 30.0, 0.0, 90.0, -179.99]
    assert codec.parse_reply(b"2 1 ", codec.MOVE_JOINTS, []) == []


@given(st.lists(st.integers(-36000, 36000), min_size=6, max_size=6))
def test_joints_survive_the_reply(hundredths: list[int]) -> None:
    text = " ".join(f"{value / 100:.2f}" for value in hundredths)
    found = codec.parse_reply(f"4 1 {text}".encode(), codec.JOINTS, JOINTS)
    assert found is not None and [round(value * 100) for value in found] == hundredths


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"3 1 1.00", "to request 04"),  # of another request
        (b"\xff\xfe", "to request 04"),
        (b"4 1 1.00 2.00 3.00 4.00 5.00 6.00 7.00" * 3, "number of decimals"),
    ],
)
def test_what_is_no_reply_to_the_request_is_refused(data: bytes, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        codec.parse_reply(data, codec.JOINTS, JOINTS)


def test_a_request_that_was_not_understood_is_named() -> None:
    with pytest.raises(DeviceError, match="did not understand request 04"):
        codec.parse_reply(b"4 0 ", codec.JOINTS, JOINTS)


@given(st.binary(max_size=100), st.sampled_from([codec.JOINTS, codec.POSE, codec.MOVE_JOINTS]))
def test_any_bytes_are_parsed_or_refused(data: bytes, code: int) -> None:
    counts = {codec.JOINTS: JOINTS, codec.POSE: codec.pose_decimals(2, 3)}.get(code, [])
    try:
        found = codec.parse_reply(data, code, counts)
    except DeviceError:
        return
    assert found is None or len(found) == len(counts)


def test_a_pose_there_and_back() -> None:
    values = [500.0, -20.0, 300.0, 0.5, 0.5, -0.5, 0.5]
    assert codec.pose_values(codec.pose_matrix(values)) == pytest.approx(values)
    with pytest.raises(FrameError, match="quaternion"):
        codec.pose_matrix([0, 0, 0, 1, 1, 0, 0])


def test_information_by_its_stars() -> None:
    assert codec.parse_information(b"98 1 14-21858*5.15*IRB 1400") == ("14-21858", "5.15", "IRB 1400")
    with pytest.raises(FrameError, match="open_abb server"):
        codec.parse_information(b"98 1 14-21858")


def test_three_decimals_of_a_quaternion_are_a_tenth_of_a_degree() -> None:
    """Why poses of the stock server are for cross-checks, not for measuring."""
    rng = np.random.default_rng(3)
    errors_deg = []
    for _ in range(200):
        q = rng.standard_normal(4)
        exact = q / np.linalg.norm(q)
        rounded = codec.pose_matrix([0, 0, 0, *np.round(exact, 3)])[:3, :3]
        turn = rounded.T @ codec.pose_matrix([0, 0, 0, *exact])[:3, :3]
        errors_deg.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    assert 0.06 < np.max(errors_deg) < 0.12

"""Every device of the table can be made, and differs from the one that would take its place."""

import pytest

from estimation.errors import CellFileError
from simulators.alone import list_devices, read_settings
from simulators.device_kind import DeviceKind
from simulators.registry import DEVICES, device_kind


@pytest.mark.parametrize("kind", DEVICES.values(), ids=lambda kind: kind.name)
def test_a_device_is_made_as_the_table_says(kind: DeviceKind) -> None:
    device = kind.simulated(3)
    if kind.link == "can":
        assert device.can is not None and not device.connect
    else:
        assert set(device.connect) == set(kind.sockets)
    assert device.restart is not None
    assert set(kind.other) <= set(kind.settings)
    assert all(kind.settings[key] != value for key, value in kind.other.items()) and kind.other
    assert f"  {kind.name} " in list_devices()


def test_mistakes_are_named_with_what_there_is() -> None:
    with pytest.raises(CellFileError, match=r"No simulated device 'nope'. Choose one of canopen-402, "):
        device_kind("nope")
    with pytest.raises(CellFileError, match=r"ur has no setting 'colour=red'. Write KEY=VALUE with one of"):
        read_settings(device_kind("ur"), ["colour=red"])
    with pytest.raises(CellFileError, match=r"node of ams-335i cannot be 'x'. Give a number"):
        read_settings(device_kind("ams-335i"), ["node=x"])

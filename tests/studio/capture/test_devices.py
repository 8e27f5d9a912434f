"""Controls and lists of cameras, against a fake of linuxpy's interface: no device is at hand."""

from __future__ import annotations

import itertools
import json
import time
import tomllib
from pathlib import Path

import pytest
from linuxpy.video.device import (
    BaseControl,
    BaseMonoControl,
    Device,
    InfoEx,
    IntegerControl,
    PixelFormat,
)

from measure.cli import main
from measure.errors import CaptureError
from measure_studio.capture import DeviceControls, bus_notes, find_devices
from measure_studio.capture.devices import watched
from measure_studio.capture.sources import Shot, Source
from tests.camera_server import ServedCamera, serving
from tests.session.conftest import jpeg
from tests.studio.capture.fake_devices import DENIED, FakeDevice, StubbornControl, machine


@pytest.fixture
def webcam(monkeypatch, tmp_path):
    device = FakeDevice()
    (path,) = machine(monkeypatch, tmp_path, [device])
    return device, path


def test_the_fake_shows_nothing_that_linuxpy_does_not():
    for name in ("card", "device_capabilities", "frame_types"):
        assert hasattr(InfoEx, name)
    for name in ("get_format", "get_fps", "__enter__"):
        assert hasattr(Device, name)
    for name in ("config_name", "is_writeable", "is_flagged_disabled", "is_flagged_write_only"):
        assert hasattr(BaseControl, name)
    assert {"value", "default"} <= set(dir(BaseMonoControl))
    assert issubclass(IntegerControl, BaseMonoControl)


def test_controls_are_set_and_what_is_automatic_is_switched_off(webcam):
    device, path = webcam
    wanted = {"exposure": "200", "focus": "auto", "power_line": "50", "brightness": "90"}
    DeviceControls(path, wanted).apply()
    assert device.control("EXPOSURE_AUTO").value == 1
    assert device.control("EXPOSURE_ABSOLUTE").value == 200
    assert device.control("FOCUS_AUTO").value
    assert device.control("POWER_LINE_FREQUENCY").value == 1
    found = DeviceControls(path).read()
    assert {name: one.setting for name, one in found.items()} == {
        "exposure": 200,
        "focus": "auto",
        "gain": 64,
        "power_line": 1,
        "brightness": 90,
    }
    DeviceControls(path, {"exposure": "auto", "power_line": "off"}).apply()
    assert device.control("EXPOSURE_AUTO").value == 3
    assert device.control("POWER_LINE_FREQUENCY").value == 0


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("exposure", "9999", r"exposure=9999: it takes 3 to 2047 in steps of 1, or auto"),
        ("gain", "auto", r"gain=auto: it takes 0 to 255 in steps of 1$"),
        ("power_line", "70", r"power_line=70: it takes 0 \(Disabled\), 1 \(50 Hz\), 2 \(60 Hz\)"),
        ("zoom", "3", r"there is no control 'zoom', only exposure, focus, gain"),
        ("exposure", "bright", r"exposure=bright: it takes"),
    ],
)
def test_what_a_control_does_not_take_is_refused(webcam, name, text, told):
    device, path = webcam
    with pytest.raises(CaptureError, match=told):
        DeviceControls(path, {name: text}).apply()
    assert device.control("EXPOSURE_ABSOLUTE").value == 156
    assert device.control("GAIN").value == 64


def test_a_control_that_does_not_take_its_value_is_told(webcam):
    device, path = webcam
    stubborn = StubbornControl("EXPOSURE_ABSOLUTE", 156, (3, 2047, 1))
    device.controls[stubborn.id] = stubborn
    with pytest.raises(CaptureError, match=r"exposure=200 was not taken: it is 156"):
        DeviceControls(path, {"exposure": "200"}).apply()


def test_locking_keeps_what_automatic_control_has_found(webcam, monkeypatch):
    """And sets it again when the camera, unplugged meanwhile, has forgotten it."""
    monkeypatch.setattr("measure_studio.capture.devices._READ_EVERY_S", 0.005)
    device, path = webcam
    controls = DeviceControls(path, {"gain": "10"})
    controls.apply()
    device.control("EXPOSURE_ABSOLUTE").value = 311
    controls.lock()
    for control in FakeDevice().controls.values():
        device.control(control.id.name).value = control.value
    controls.apply()
    found = {name: one.setting for name, one in controls.read().items()}
    assert [found[name] for name in ("exposure", "focus", "gain")] == [311, 30, 10]


def test_an_exposure_that_changes_is_named(webcam, monkeypatch):
    monkeypatch.setattr("measure_studio.capture.devices._LOOK_EVERY_S", 0.01)
    device, path = webcam
    with watched({"cam0": DeviceControls(path)}, lock=False) as still:
        time.sleep(0.05)
    assert not still.changed
    assert still.settings["cam0"]["exposure"] == "auto"
    with watched({"cam0": DeviceControls(path)}, lock=False) as record:
        device.control("EXPOSURE_ABSOLUTE").value = 312
        time.sleep(0.05)
        device.control("EXPOSURE_ABSOLUTE").value = 156  # and back: it is told all the same
    told = "cam0 changed its exposure from 156 to 312: --lock keeps what it has found"
    assert list(record.changed.values()) == [told]


def test_cameras_are_listed_with_addresses_that_last(monkeypatch, tmp_path):
    devices = [FakeDevice(), FakeDevice(captures=False), FakeDevice()]
    machine(monkeypatch, tmp_path, devices, serials=("A1", "", "B2"))
    first, second = find_devices()
    assert first.name == "HD Webcam"
    assert (first.bus, first.bus_mbit_s) == ("usb1", 480.0)
    assert first.address.endswith("by-id/usb-HD_Webcam_A1-video-index0")
    assert first.path.endswith("/video0")
    assert second.address.endswith("by-id/usb-HD_Webcam_B2-video-index0")
    assert first.modes[0].form == "MJPG"
    assert first.modes[0].rates_hz == (30.0, 15.0, 5.0)
    assert first.now.size_wh == (1280, 720)
    assert [control.name for control in first.controls][:2] == ["exposure", "focus"]


def test_cameras_of_one_serial_number_are_told_apart_by_their_sockets(monkeypatch, tmp_path):
    machine(monkeypatch, tmp_path, [FakeDevice(), FakeDevice()], serials=("X", "X"))
    assert ["by-path" in one.address for one in find_devices()] == [True, True]
    assert len({one.address for one in find_devices()}) == 2


def test_a_camera_that_may_not_be_opened_says_so(monkeypatch, tmp_path):
    machine(monkeypatch, tmp_path, [FakeDevice(refuses=DENIED)])
    (found,) = find_devices()
    assert found.name == "HD Webcam"
    assert found.problem.endswith("may be read by the group 'video' only: join it")


def test_what_a_bus_cannot_carry_is_told_with_what_would_fit(monkeypatch, tmp_path):
    raw = [FakeDevice(forms=(PixelFormat.YUYV,)) for _ in range(3)]
    machine(monkeypatch, tmp_path, raw)
    found = {f"cam{k}": one for k, one in enumerate(find_devices())}
    sizes = dict.fromkeys(found, (640, 480))
    (note,) = bus_notes(found, sizes, None)
    # 640 x 480 x 16 bits x 30 a second are 147 Mbit/s a camera; 15 a second halve that.
    assert note.startswith("usb1 carries about 280 Mbit/s of pictures and is asked for about 442")
    assert "cam0 147, cam1 147, cam2 147" in note
    assert "--rate 15 would fit" in note
    assert bus_notes(found, sizes, 15.0) == []
    assert bus_notes(dict([*found.items()][:1]), sizes, None) == []
    (large,) = bus_notes(found, dict.fromkeys(found, (1920, 1080)), 15.0)
    assert "--rate" not in large  # 5 a second, the lowest rate, need 498 Mbit/s
    assert large.endswith("use smaller pictures or connect some of these cameras to another bus")


def test_motion_jpeg_is_chosen_where_a_camera_has_it(monkeypatch, tmp_path):
    machine(monkeypatch, tmp_path, [FakeDevice() for _ in range(3)])
    found = {f"cam{k}": one for k, one in enumerate(find_devices())}
    assert bus_notes(found, {}, 30.0) == []
    mode, rate = found["cam0"].asked(None, None)
    assert (mode.form, rate) == ("MJPG", 30.0)


class FakeSource(Source):
    """Pictures of a device without the device; its controls are set as it is opened."""

    settles = False

    def __init__(self, address, size_wh, rate_hz, controls):
        super().__init__(address)
        self.controls = DeviceControls(Path(address), controls)

    def shots(self):
        self.controls.apply()
        for level in itertools.count():
            time.sleep(0.02)
            yield Shot(time.monotonic(), None, jpeg(level % 250, (64, 48)))


def test_controls_are_set_by_a_command_and_written_into_the_session(
    webcam, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("measure_studio.capture.addresses.device_source", FakeSource)
    monkeypatch.setattr(
        "measure_studio.capture.addresses.CameraAddress.is_device", property(lambda self: True)
    )
    monkeypatch.setattr("measure_studio.capture.devices._READ_EVERY_S", 0.005)
    _, path = webcam
    cameras = [f"cam0={path}", f"cam1={path}", "--seconds", "0.4"]
    out = tmp_path / "kept"
    asked = ["--control", "gain=9, power_line=50", "--control", "cam1.gain=9", "--lock"]
    assert main(["record", *cameras, "-o", str(out), *asked]) == 0
    tables = tomllib.loads((out / "session.toml").read_text())["cameras"]
    same = {"exposure": 156, "focus": 30, "gain": 9, "power_line": 1, "brightness": 128}
    assert [table["controls"] for table in tables] == [same, same]
    capsys.readouterr()
    out = tmp_path / "not"
    assert main(["record", *cameras, "-o", str(out), "--control", "exposure=0"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "camera 'cam" in line
    assert "exposure=0: it takes 3 to 2047" in line
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("exposure", "--control exposure: expected NAME=VALUE, such as exposure=150"),
        ("cam7.gain=3", "--control cam7.gain: cam7 is no camera of this machine"),
    ],
)
def test_controls_that_are_none_are_refused_first(tmp_path, capsys, text, told):
    command = ["record", "cam0=/dev/null", "-o", str(tmp_path / "s"), "--control", text]
    assert main(command) == 2
    assert told in capsys.readouterr().err


def test_the_list_as_a_person_and_a_program_read_it(webcam, capsys):
    assert main(["cameras", "--json"]) == 0
    (camera,) = json.loads(capsys.readouterr().out)["cameras"]
    assert camera["modes"][0] == {
        "form": "MJPG", "size_wh": [1920, 1080], "rates_hz": [30.0, 15.0, 5.0]
    }  # fmt: skip
    assert camera["controls"][0]["automatic"]
    assert main(["cameras"]) == 0
    text = capsys.readouterr().out
    assert "exposure = 156 (auto): 3 to 2047 in steps of 1, or auto; default 156" in text
    assert "MJPG 1280x720 at 30, 15, 5 a second" in text


def test_a_network_camera_is_asked_by_its_address(capsys):
    served = {"a": ServedCamera([jpeg(40, (64, 48)), jpeg(90, (64, 48))], stamps=True)}
    with serving(served) as addresses:
        gone = "http://me:secret@127.0.0.1:1/x?token=secret"
        assert main(["cameras", addresses["a"], gone, "--json"]) == 0
    heard, refused = json.loads(capsys.readouterr().out)["cameras"]
    assert heard["now"]["size_wh"] == [64, 48]
    assert heard["now"]["rates_hz"][0] == pytest.approx(30.0, rel=0.1)
    assert heard["own_clock"]
    assert "Connection refused" in refused["problem"]
    assert "secret" not in json.dumps(refused)


def test_a_machine_without_cameras_says_so(monkeypatch, tmp_path, capsys):
    machine(monkeypatch, tmp_path, [])
    assert main(["cameras"]) == 0
    assert capsys.readouterr().out.startswith("this machine has no cameras")
    assert main(["cameras", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"cameras": []}

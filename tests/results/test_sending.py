"""Poses sent on: whoever listens where it is usual hears them."""

from __future__ import annotations

import json
import socket
import sys

import pytest

from measure.errors import ConfigError
from measure.results import PoseSender
from tests.results.conftest import measurement


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.settimeout(5.0)
        one.bind(("0.0.0.0", 0))
        yield one


def test_a_name_with_addresses_of_both_kinds_is_sent_to_by_ipv4(receiver, monkeypatch):
    port = receiver.getsockname()[1]
    both = [
        (socket.AF_INET6, socket.SOCK_DGRAM, 17, "", ("::1", port, 0, 0)),
        (socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.1", port)),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: both)
    with PoseSender(("localhost", port)) as sender:
        sender.send(measurement(0))
    assert json.loads(receiver.recv(65_536))["frame"] == 0


@pytest.mark.skipif(sys.platform != "linux", reason="loopback broadcasts on Linux only")
def test_everyone_can_be_sent_to_at_once(receiver):
    with PoseSender(("127.255.255.255", receiver.getsockname()[1])) as sender:
        sender.send(measurement(0))
    assert json.loads(receiver.recv(65_536))["frame"] == 0


def test_a_host_that_is_none_is_told():
    with pytest.raises(ConfigError, match=r"cannot send to nowhere\.invalid:5005"):
        PoseSender(("nowhere.invalid", 5005))

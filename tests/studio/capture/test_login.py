"""Logins and certificates of network cameras."""

from __future__ import annotations

import hashlib
import re
import socket
import ssl
import threading
from contextlib import closing

import pytest

from measure.errors import CaptureError
from measure_studio.capture import mjpeg
from measure_studio.capture.mjpeg import HttpSource, answer_to
from tests.camera_server import ServedCamera, serving

PICTURE = b"\xff\xd8picture\xff\xd9"
# Of a camera's own, and of nobody else's.
CERTIFICATE = """-----BEGIN CERTIFICATE-----
MIIBeDCCAR+gAwIBAgIUJcgP2LeHeBe02sL+aoBWY1Cem7kwCgYIKoZIzj0EAwIw
ETEPMA0GA1UEAwwGY2FtZXJhMCAXDTI2MTEyODE5MDkzMloYDzIxMjYxMTA0MTkw
OTMyWjARMQ8wDQYDVQQDDAZjYW1lcmEwWTATBgcqhkjOPQIBBggqhkjOPQMBBwNC
AARM3yAMwK0L7ten11vn31oZ0nXQPaxpb66i+f77dC0MJ8zSZ4+Sa/1vXAdUMtAc
TCaRGunwn6JRrbxeAlU5WaXmo1MwUTAdBgNVHQ4EFgQUwoiDFmxocpeqL+LEGAFl
ryMRiFIwHwYDVR0jBBgwFoAUwoiDFmxocpeqL+LEGAFlryMRiFIwDwYDVR0TAQH/
BAUwAwEB/zAKBggqhkjOPQQDAgNHADBEAiBf2hxj7o2pKp3pBa6x8vbG23a0yjG+
DQsRlDMtyygYOQIgCu/gj+TSgH77qPJdUXIL/2m9T2nIdyW3kKnGN5+7u/Y=
-----END CERTIFICATE-----
"""
KEY = """-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgDDbzBIyB3zr/iW1L
97WOulmRLu+HiJIYF5gfhZGjmQ6hRANCAARM3yAMwK0L7ten11vn31oZ0nXQPaxp
b66i+f77dC0MJ8zSZ4+Sa/1vXAdUMtAcTCaRGunwn6JRrbxeAlU5WaXm
-----END PRIVATE KEY-----
"""
SHA256 = hashlib.sha256(ssl.PEM_cert_to_DER_cert(CERTIFICATE)).hexdigest()
RFC_7616 = (
    'Digest realm="http-auth@example.org", qop="auth, auth-int", '
    'nonce="7ypf/xlj9XXwfDPEoM4URrv/xwf94BcCAzFZH4GiTo0v", algorithm='
)


@pytest.mark.parametrize(
    ("challenge", "password", "response"),
    [
        (RFC_7616 + "MD5", "Circle of Life", "8ca523f5e9506fed4657c9700eebdbec"),
        (
            RFC_7616 + "SHA-256",
            "Circle of Life",
            "753927fa0e85d155564e2e272a28d1802ca10daf4496794697cf8db5856cb6c1",
        ),
        (  # RFC 2069, as corrected
            'Digest realm="testrealm@host.com", nonce="dcd98b7102dd2f0e8b11d0f600bfb0c093"',
            "CircleOfLife",
            "1949323746fe6a43ef61f9606e7febea",
        ),
    ],
)
def test_digest_answers_are_those_of_the_standards(challenge, password, response, monkeypatch):
    nonce = "f2/wE4q74E6zIJEtWaHKaf5wv/H5QzzpXusqGemxURZJ"
    monkeypatch.setattr(mjpeg.secrets, "token_hex", lambda _: nonce)
    said = answer_to(['Basic realm="b"', challenge], ("Mufasa", password), "/dir/index.html")
    assert f'response="{response}"' in said


def test_a_camera_that_asks_for_digest_gets_no_password():
    camera = ServedCamera([PICTURE], password="secret", challenges=[RFC_7616 + "MD5"])
    with serving({"cam0": camera}) as addresses:
        address = addresses["cam0"].replace("http://", "http://viewer:secret@")
        with closing(HttpSource(address).shots()) as shots:
            assert next(shots).jpeg == PICTURE
        (nothing, answer) = camera.answers
        assert nothing == ""
        assert 'username="viewer"' in answer
        camera.challenges = ["NTLM"]
        with pytest.raises(CaptureError, match=r"not spoken here \(NTLM\): set it to digest"):
            next(HttpSource(address).shots())
        with pytest.raises(CaptureError, match="asks for user and password: http://USER:PASS"):
            next(HttpSource(addresses["cam0"]).shots())


@pytest.fixture
def address(tmp_path):
    """A camera over HTTPS, with a certificate of its own: it answers 404."""
    (tmp_path / "c.pem").write_text(KEY + CERTIFICATE)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "c.pem")
    server = socket.create_server(("127.0.0.1", 0))

    def serve():
        for _ in range(2):  # a refused certificate is asked for again, to name its fingerprint
            try:
                with context.wrap_socket(server.accept()[0], server_side=True) as client:
                    if client.recv(1000):
                        client.sendall(b"HTTP/1.1 404 None\r\n\r\n")
            except OSError:
                continue

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    with server:
        yield f"https://127.0.0.1:{server.getsockname()[1]}/"


@pytest.mark.parametrize(
    ("trusted", "told"),
    [
        ("", f"not to be verified .*add to the address: #sha256={SHA256}"),
        (f"#sha256={SHA256}", "answers 404"),
        ("#certificate={}/c.pem", "answers 404"),
        (f"#sha256={'0' * 64}", f"another one than you trust: its SHA-256 is {SHA256}"),
        ("#certificate={}/none.pem", "No such file"),
        ("#sha256=12", "expected sha256=FINGERPRINT"),
    ],
)
def test_a_certificate_of_its_own_is_taken_if_it_is_the_one_that_is_trusted(
    address, trusted, told, tmp_path
):
    with pytest.raises(CaptureError, match=told) as error:
        next(HttpSource(address + trusted.format(tmp_path)).shots())
    assert re.match(re.escape(address), str(error.value))

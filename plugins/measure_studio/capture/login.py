"""Logins and certificates of network cameras: what a challenge is answered, and who is trusted."""

from __future__ import annotations

import base64
import hashlib
import re
import secrets
import ssl
from collections.abc import Iterable
from contextlib import closing
from http.client import HTTPConnection, HTTPSConnection
from pathlib import Path
from urllib.request import parse_http_list, parse_keqv_list

from measure.errors import CaptureError
from measure_studio.capture.sources import PATIENCE_S
from measure_studio.capture.web_address import WebAddress

_SCHEME = re.compile(r"(?:^|,)\s*(?=(?:Basic|Digest|Bearer|NTLM|Negotiate)\b)", re.IGNORECASE)
_CERTIFICATE = re.compile("-----BEGIN CERTIFICATE-----.*?-----END CERTIFICATE-----", re.DOTALL)
_HASHES = {"MD5": hashlib.md5, "SHA-256": hashlib.sha256}
_CLIENT_NONCE_BYTES = 8


def answer_to(challenges: Iterable[str], login: tuple[str, str], target: str) -> str:
    """What an `Authorization` header says to the first challenge that is understood.

    Args:
        challenges: the `WWW-Authenticate` headers; a camera that sends none is taken to ask for a
            basic login.
        login: user name and password.
        target: what is asked for with GET, as it is sent.

    Raises:
        ValueError: the camera asks for a login of another kind; the text names it.
    """
    asked = [one.strip() for line in challenges for one in _SCHEME.split(line) if one.strip()]
    for one in sorted(asked or ["Basic"], key=lambda text: text.lower().startswith("basic")):
        scheme, _, rest = one.partition(" ")
        if scheme.lower() == "basic":
            pair = ":".join(login).encode()
            return f"Basic {base64.b64encode(pair).decode()}"
        if scheme.lower() == "digest":
            known = parse_keqv_list([part for part in parse_http_list(rest) if "=" in part])
            answer = _digest({name.lower(): value for name, value in known.items()}, login, target)
            if answer:
                return answer
    raise ValueError(", ".join(one.partition(" ")[0] for one in asked))


def _digest(asked: dict[str, str], login: tuple[str, str], target: str) -> str:
    """RFC 7616, 3.4; empty for an algorithm or a protection of another kind."""
    algorithm, qops = asked.get("algorithm", "MD5"), asked.get("qop", "")
    make = _HASHES.get(algorithm.upper().removesuffix("-SESS"))
    protections = [one.strip().lower() for one in qops.split(",")]
    if make is None or "nonce" not in asked or (qops and "auth" not in protections):
        return ""

    def digest(*parts: str) -> str:
        return make(":".join(parts).encode()).hexdigest()

    user, realm, nonce = login[0], asked.get("realm", ""), asked["nonce"]
    client_nonce, count = secrets.token_hex(_CLIENT_NONCE_BYTES), "00000001"
    secret = digest(user, realm, login[1])
    if algorithm.upper().endswith("-SESS"):
        secret = digest(secret, nonce, client_nonce)
    once = (nonce, count, client_nonce, "auth") if qops else (nonce,)
    response = digest(secret, *once, digest("GET", target))
    said = {"username": user, "realm": realm, "nonce": nonce, "uri": target, "response": response}
    said |= {"opaque": asked["opaque"]} if "opaque" in asked else {}
    said |= {"cnonce": client_nonce} if qops or algorithm.upper().endswith("-SESS") else {}
    quoted = [f'{name}="{_escaped(value)}"' for name, value in said.items()]
    plain = [f"algorithm={algorithm}"] if "algorithm" in asked else []
    plain += ["qop=auth", f"nc={count}"] if qops else []
    return f"Digest {', '.join([*quoted, *plain])}"


def _escaped(text: str) -> str:
    """For a quoted string of a header, which holds bytes: those of UTF-8."""
    return text.replace("\\", "\\\\").replace('"', '\\"').encode().decode("latin-1")


def connected(place: WebAddress, trusted: str, where: str) -> HTTPConnection:
    """A connection to a camera.

    Args:
        trusted: what follows the # in its address: `sha256=` and the fingerprint of its own
            certificate, or `certificate=` and the file that holds it; empty: one that this
            computer knows.

    Raises:
        CaptureError: its certificate is another one, or the file holds none.
        OSError: it cannot be reached.
    """
    if place.scheme != "https":
        return HTTPConnection(place.place, timeout=PATIENCE_S)
    wanted = _fingerprint(trusted, where)
    context = _unverifying() if wanted else ssl.create_default_context()
    connection = HTTPSConnection(place.place, timeout=PATIENCE_S, context=context)
    try:
        connection.connect()
    except ssl.SSLCertVerificationError as problem:
        asked = HTTPSConnection(place.place, timeout=PATIENCE_S, context=_unverifying())
        with closing(asked):
            asked.connect()
            shown = hashlib.sha256(asked.sock.getpeercert(binary_form=True) or b"").hexdigest()
        raise CaptureError(
            f"{where}: its certificate is not to be verified ({problem.verify_message}). If it is "
            f"the camera's own, add to the address: #sha256={shown}"
        ) from None
    found = hashlib.sha256(connection.sock.getpeercert(binary_form=True) or b"").hexdigest()
    if wanted and found != wanted:
        connection.close()
        raise CaptureError(
            f"{where}: its certificate is another one than you trust: its SHA-256 is {found}"
        )
    return connection


def _unverifying() -> ssl.SSLContext:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def _fingerprint(trusted: str, where: str) -> str:
    """SHA-256 of the certificate to trust, in hexadecimal digits; empty for none of its own."""
    kind, _, value = trusted.partition("=")
    digits = value.replace(":", "").lower()
    if kind == "sha256" and re.fullmatch("[0-9a-f]{64}", digits):
        return digits
    if kind == "certificate":
        try:
            text = Path(value).read_text("latin-1")
            first = _CERTIFICATE.search(text)
            return hashlib.sha256(ssl.PEM_cert_to_DER_cert(first[0] if first else "")).hexdigest()
        except (OSError, ValueError) as problem:
            why = getattr(problem, "strerror", None) or "it holds no certificate (PEM)"
            raise CaptureError(f"{where}: {value}: {why}") from None
    if trusted:
        raise CaptureError(
            f"{where}: after # is expected sha256=FINGERPRINT, 64 hexadecimal digits, or "
            "certificate=FILE"
        )
    return ""

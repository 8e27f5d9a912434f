"""Addresses of network cameras: their parts, and what of them may be shown."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from urllib.parse import quote, unquote, urljoin, urlsplit

_PARTS = re.compile(r"([a-z][\w+.-]*)://([^/?#]*)([^?#]*)(.*)", re.DOTALL | re.IGNORECASE)
_PORTS = {"http": 80, "https": 443}
_HIDDEN = "..."
_KEPT = "%/?:@!$&'()*+,;=-._~[]"
"""Signs of a request's target that are not escaped, beside letters and digits."""


def shown(address: str) -> str:
    """An address as messages, files and reports show it: without what may be a secret.

    User name, password and query are left out, and what follows an equals sign in the path. The one
    door for it: whatever holds an address shows it by this function.
    """
    parts = _PARTS.fullmatch(address)
    if parts is None:  # a file or a device, or an address without its scheme
        return re.sub(r"\?.*", f"?{_HIDDEN}", re.sub(r".*:.*@", "", address))
    scheme, host, path, rest = parts.groups()
    if "@" in path + rest:  # a password with unescaped signs ends nobody knows where
        return f"{scheme}://{_HIDDEN}"
    path = re.sub(r"=[^/]*", f"={_HIDDEN}", path)
    return f"{scheme}://{host.rpartition('@')[2]}{path}{f'?{_HIDDEN}' if rest[:1] == '?' else ''}"


@dataclass(frozen=True)
class WebAddress:
    """Where to ask for a stream over HTTP."""

    scheme: str  # `http` or `https`
    place: str  # host and port, the latter unless it is the scheme's own
    target: str = field(repr=False)  # path and query, escaped
    login: tuple[str, str] | None = field(default=None, repr=False)  # user name and password
    fragment: str = field(default="", repr=False)  # what follows a #, which is sent to nobody

    @classmethod
    def parse(cls, address: str) -> WebAddress:
        """Read one; ValueError if it is none of this kind: its text may hold the password."""
        parts = urlsplit(address)
        if parts.scheme not in _PORTS or not parts.hostname:
            raise ValueError("no http:// or https:// address")
        target = quote(parts.path or "/", _KEPT)
        if parts.query:
            target += f"?{quote(parts.query, _KEPT)}"
        login = None
        if parts.username is not None:
            login = unquote(parts.username), unquote(parts.password or "")
        host = parts.hostname.encode("idna").decode()
        place = f"[{host}]" if ":" in host else host
        if parts.port not in (None, _PORTS[parts.scheme]):
            place += f":{parts.port}"
        return cls(parts.scheme, place, target, login, parts.fragment)

    @property
    def origin(self) -> tuple[str, str]:
        """Whom a password given for this address is sent to."""
        return self.scheme, self.place

    @property
    def url(self) -> str:
        """The address without its login."""
        return f"{self.scheme}://{self.place}{self.target}"

    def redirected(self, location: str) -> WebAddress:
        """Where an answer's `Location` leads, without a login; ValueError if to no HTTP address."""
        return WebAddress.parse(urljoin(self.url, location))

"""Who is let in: this machine, or whoever knows the token; no page of another site."""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit

import pytest

from measure_studio.page.door import Door

HERE = "127.0.0.1:8080"
INSIDE = [{"type": "inside"}]


async def inner(scope, receive, send):
    """What stands behind the door."""
    await send({"type": "inside"})


def answer(token="", kind="http", query="", **headers):
    """What is sent to a request with these headers: `INSIDE` if it came in."""
    headers = {"host": HERE, **headers}
    sent = []

    async def send(message):
        sent.append(message)

    scope = {
        "type": kind,
        "path": "/measure",
        "query_string": query.encode(),
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
    }
    asyncio.run(Door(inner, token)(scope, None, send))
    return sent


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("headers", "comes_in"),
    [
        ({}, True),
        ({"host": "localhost:8080"}, True),
        ({"host": "[::1]:8080"}, True),
        ({"origin": f"http://{HERE}"}, True),
        ({"host": "evil.example:8080"}, False),  # a name that was led to 127.0.0.1
        ({"host": ""}, False),
        ({"host": "evil@127.0.0.1:8080"}, False),
        ({"host": "127.0.0.1:8080@evil.example"}, False),
        ({"host": "[::1"}, False),
        ({"origin": "http://[bad"}, False),
        ({"origin": "http://evil.example"}, False),
        ({"origin": "http://127.0.0.1:9999"}, False),  # another program's page on this machine
        ({"origin": "null"}, False),
        ({"host": "evil.example", "origin": "http://evil.example"}, False),
    ],
)
def test_on_loopback_only_its_own_pages_come_in(kind, headers, comes_in):
    sent = answer(kind=kind, **headers)
    if comes_in:
        assert sent == INSIDE
    elif kind == "http":
        assert sent[0]["status"] == 403
    else:
        assert sent == [{"type": "websocket.close", "code": 1008}]


@pytest.mark.parametrize(
    ("query", "headers"),
    [
        ("", {}),
        ("token=wrong", {}),
        ("token=", {}),
        ("", {"cookie": "studio=wrong"}),
        ("", {"cookie": "studio"}),
        ("", {"cookie": 'studio="secr'}),
        ("", {"cookie": "studio=secret", "origin": "http://evil.example"}),
    ],
)
def test_elsewhere_nobody_comes_in_without_the_token(query, headers):
    for kind, refusal in (("http", "status"), ("websocket", "code")):
        (first, *_) = answer("secret", kind, query, host="10.0.0.7:8080", **headers)
        assert first.get(refusal) in (403, 1008)


@pytest.mark.parametrize("host", ["", ":8080", "who@10.0.0.7:8080"])
def test_a_token_opens_for_no_odd_host(host):
    (first, *_) = answer("secret", host=host, cookie="studio=secret")
    assert first["status"] == 403


def test_pages_may_ask_their_own_server_alone_and_stand_in_no_foreign_frame():
    async def page(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    sent = []

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "headers": [(b"host", HERE.encode())], "query_string": b""}
    asyncio.run(Door(page)(scope, None, send))
    policy = dict(sent[0]["headers"])[b"content-security-policy"]
    rules = dict(rule.split(maxsplit=1) for rule in policy.decode().split("; "))
    assert rules["default-src"].startswith("'self'")
    assert not [word for rule in rules.values() for word in rule.split() if "//" in word][1:]
    assert rules["connect-src"].endswith("http://127.0.0.1:*")
    assert rules["frame-ancestors"] == "'self'"


def test_every_answer_is_for_pages_of_this_server_alone():
    refused, *_ = answer(host="evil.example")
    led, *_ = answer("secret", query="token=secret", host="10.0.0.7:8080")
    for one in (refused, led):
        headers = {name.decode(): value.decode() for name, value in one["headers"]}
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert "frame-ancestors 'self'" in headers["content-security-policy"]


def test_the_token_becomes_a_cookie_and_leaves_the_address():
    (led, *_) = answer("secret", query="token=secret", host="10.0.0.7:8080")
    headers = {name.decode(): value.decode() for name, value in led["headers"]}
    assert led["status"] == 303
    assert headers["location"] == "/measure"
    cookie, *manners = headers["set-cookie"].split("; ")
    assert {"HttpOnly", "SameSite=strict"} <= set(manners)
    for kind in ("http", "websocket"):
        assert answer("secret", kind, host="10.0.0.7:8080", cookie=cookie) == INSIDE


@pytest.mark.parametrize("path", ["//evil.example/", "///evil.example", "/\\evil.example", "//"])
def test_the_token_leads_to_no_other_server(path):
    sent = []

    async def send(message):
        sent.append(message)

    scope = {
        "type": "http",
        "path": path,
        "query_string": b"token=secret",
        "headers": [(b"host", b"10.0.0.7:8080")],
    }
    asyncio.run(Door(inner, "secret")(scope, None, send))
    location = dict(sent[0]["headers"])[b"location"].decode()
    assert sent[0]["status"] == 303
    assert urlsplit(location).netloc == ""
    assert location.startswith("/")
    assert location[1:2] not in ("/", "\\")

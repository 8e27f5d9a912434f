"""A checksum inside an ONNX file: a weight that changed on the way would give wrong millimetres.

A serialised protobuf message may be continued by appending fields, so the sealed file is the model
followed by one more entry of its metadata, `sha256` of all bytes before it; any ONNX runtime reads
it as before.
"""

from __future__ import annotations

import hashlib

# Field 14 of ModelProto (metadata_props), an entry of 74 bytes: key `sha256`, a value of 64 bytes.
_HEAD = b"\x72\x4a\x0a\x06sha256\x12\x40"


def seal(body: bytes) -> bytes:
    """A serialised model with its checksum."""
    return body + _HEAD + hashlib.sha256(body).hexdigest().encode()


def is_intact(content: bytes) -> bool:
    """Whether a file is sealed, and every byte is as it was then."""
    return content == seal(content[: -len(_HEAD) - 64])

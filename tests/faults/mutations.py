"""Random changes to messages and files: some are blind, some know what they change."""

from __future__ import annotations

import random
import struct
import zlib

import zstandard
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

INTEGERS = (0, 1, 2, 7, 255, 256, 65_535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, -1)
REALS = (0.0, -0.0, 1.0, -1.0, 1e-310, 1e-9, 1e6, 1e30, 1.8e308, float("inf"), float("-inf"),
         float("nan"), 0.5, 1.0011, 3.4e38)  # fmt: skip
TEXTS = ("", " ", "\0", "\n", "x" * 64, "x" * 5000, "../../etc/passwd", "sessions/", "sessions/a/b",
         "sessions/../agents/x", "sessions/fuzz/agents/agent_0/submaps/-1",
         "sessions/fuzz/agents/agent_0/submaps/99999999999", "\u202e\U0001f600", "a\u0301" * 100,
         "image/gif", "sessions/fuzz", "sessions/fuzz/agents/agent_0",
         "sessions/fuzz/agents/agent_0/submaps/0", "%s%n", "'; DROP TABLE submaps; --")  # fmt: skip
_WIDTH = {
    FieldDescriptor.CPPTYPE_INT32: (-(2**31), 2**31 - 1),
    FieldDescriptor.CPPTYPE_INT64: (-(2**63), 2**63 - 1),
    FieldDescriptor.CPPTYPE_UINT32: (0, 2**32 - 1),
    FieldDescriptor.CPPTYPE_UINT64: (0, 2**64 - 1),
    FieldDescriptor.CPPTYPE_ENUM: (-(2**31), 2**31 - 1),
}


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """One to four blind changes: bits, bytes, runs, cuts, insertions, doubled and moved pieces."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        if not out:
            out += rng.randbytes(rng.randrange(1, 20))
            continue
        at = rng.choice((rng.randrange(len(out)), rng.randrange(min(len(out), 64))))
        length = rng.choice((1, 1, 2, 4, 8, rng.randrange(1, 200)))
        match rng.randrange(8):
            case 0:
                out[at] ^= 1 << rng.randrange(8)
            case 1:
                out[at] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
            case 2:
                out[at : at + length] = rng.randbytes(length)
            case 3:
                del out[at : at + length]
            case 4:
                out[at:at] = rng.randbytes(length)
            case 5:
                out[at:at] = out[at : at + length]
            case 6:
                del out[at:]
            case 7:
                value = rng.choice(INTEGERS) & 0xFFFFFFFF
                out[at : at + 4] = value.to_bytes(4, rng.choice(("little", "big")))
    return bytes(out)


def mutate_message(message: Message, rng: random.Random) -> None:
    """One to three changes to fields anywhere inside, in place."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        _mutate_field(_somewhere(message, rng), rng)


def _somewhere(message: Message, rng: random.Random) -> Message:
    """The message itself or one inside it."""
    inside: list[Message] = []
    for field, value in message.ListFields():
        if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
            inside += list(value)[:50] if field.is_repeated else [value]
    if inside and rng.random() < 0.6:
        return _somewhere(rng.choice(inside), rng)
    return message


def _mutate_field(message: Message, rng: random.Random) -> None:
    fields = message.DESCRIPTOR.fields
    if not fields:
        return
    field = rng.choice(fields)
    if rng.random() < 0.15:
        message.ClearField(field.name)
    elif field.is_repeated:
        _mutate_repeated(getattr(message, field.name), field, rng)
    elif field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
        inner = getattr(message, field.name)
        inner.SetInParent()
        _mutate_field(inner, rng)
    else:
        setattr(message, field.name, _value(field, getattr(message, field.name), rng))


def _mutate_repeated(values, field: FieldDescriptor, rng: random.Random) -> None:
    plain = field.cpp_type != FieldDescriptor.CPPTYPE_MESSAGE
    match rng.randrange(5) if len(values) else 4:
        case 0:
            del values[rng.randrange(len(values))]
        case 1:
            values.extend([values[rng.randrange(len(values))]] * rng.choice((1, 1, 3, 40)))
        case 2:
            values.reverse()
        case 3 if plain:
            at = rng.randrange(len(values))
            values[at] = _value(field, values[at], rng)
        case 3:
            _mutate_field(values[rng.randrange(len(values))], rng)
        case _:
            if plain:
                values.append(_value(field, None, rng))
            else:
                _mutate_field(values.add(), rng)


def _value(field: FieldDescriptor, old, rng: random.Random):
    kind = field.cpp_type
    if kind in _WIDTH:
        low, high = _WIDTH[kind]
        near = (old or 0) + rng.choice((-1, 1, 2))
        value = rng.choice((*INTEGERS, near, near, near))
        return min(max(value, low), high)
    if kind in (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT):
        return rng.choice((*REALS, -(old or 0.0), (old or 0.0) * 1.01, rng.uniform(-10, 10)))
    if kind == FieldDescriptor.CPPTYPE_BOOL:
        return not old
    if field.type == FieldDescriptor.TYPE_BYTES:
        return mutated_bytes(old or b"", rng)
    return rng.choice((*TEXTS, (old or "")[:-1], (old or "") + rng.choice("/.\0a")))


def mutated_frame(data: bytes, rng: random.Random, *, header_bytes: int) -> bytes:
    """A header and a zstd frame with blind changes, or with a changed content in a whole frame."""
    if rng.random() < 0.4:
        return mutated_bytes(data, rng)
    content = bytearray(zstandard.ZstdDecompressor().decompress(data[header_bytes:]))
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.choice((rng.randrange(len(content)), rng.randrange(min(48, len(content)))))
        if rng.random() < 0.5:
            content[at] = rng.randrange(256)
        else:
            kind = rng.choice(("<f", "<d"))
            value = rng.choice([v for v in REALS if kind == "<d" or abs(v) != 1.8e308])
            piece = struct.pack(kind, value)
            content[at // 4 * 4 : at // 4 * 4 + len(piece)] = piece
    if rng.random() < 0.3:
        content = content[: rng.randrange(len(content))]
    header = bytearray(data[:header_bytes])
    if rng.random() < 0.3:
        header[4 + rng.randrange(header_bytes - 4)] = rng.randrange(256)
    return bytes(header) + zstandard.ZstdCompressor(level=1).compress(bytes(content))


def mutated_png(data: bytes, rng: random.Random) -> bytes:
    """A PNG with blind changes, or with a changed chunk whose checksum is right."""
    if rng.random() < 0.5:
        return mutated_bytes(data, rng)
    chunks, at = [], 8
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    which = rng.randrange(len(chunks))
    match rng.randrange(4):
        case 0:
            del chunks[which]
        case 1:
            chunks.insert(which, chunks[which])
        case 2:
            kind = rng.choice((b"tEXt", b"eXIf", b"PLTE", b"IDAT", b"tRNS", b"acTL", b"iCCP"))
            chunks.insert(which, (kind, rng.randbytes(rng.randrange(100))))
        case 3:
            chunks[which] = (chunks[which][0], mutated_bytes(chunks[which][1], rng))
    return data[:8] + b"".join(
        len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")
        for kind, body in chunks
    )

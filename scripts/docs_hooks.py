"""MkDocs hooks: reference pages of the service, from its .proto files, and of the commands."""

from __future__ import annotations

import contextlib
import importlib
import io
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2

ROOT = Path(__file__).resolve().parents[1]
SERVICE_PAGE, COMMANDS_PAGE = "api/service.md", "api/commands.md"
_MESSAGE, _ENUM, _SERVICE, _FIELD, _METHOD, _VALUE = 4, 5, 6, 2, 2, 2
_SCALARS = {
    value: name.removeprefix("TYPE_").lower()
    for name, value in descriptor_pb2.FieldDescriptorProto.Type.items()
}


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Fill the pages that stand for the contract and for the command line."""
    if page.file.src_uri == SERVICE_PAGE:
        lines = [line for file in contract().file for line in describe(file)]
    elif page.file.src_uri == COMMANDS_PAGE:
        lines = list(commands())
    else:
        return markdown
    return markdown + "\n" + "\n".join(lines)


def commands() -> Iterator[str]:
    """The help of every command, as a terminal shows it."""
    from magic_cli.main import COMMANDS, run_command

    for name, (module, summary) in COMMANDS.items():
        nested = getattr(importlib.import_module(module), "BENCHMARKS", {})
        yield f"## magic {name}\n\n{summary[0].upper()}{summary[1:]}.\n"
        for words in ([name], *([name, inner] for inner in nested)):
            text = io.StringIO()
            with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
                run_command([*words, "--help"])
            lines = "\n".join(line.rstrip() for line in text.getvalue().splitlines())
            yield f"```text\n$ magic {' '.join(words)} --help\n{lines.strip()}\n```\n"


def contract() -> descriptor_pb2.FileDescriptorSet:
    """The .proto files as descriptors, comments included."""
    files = sorted((ROOT / "proto" / "magicslam" / "v1").glob("*.proto"))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "contract.pb"
        subprocess.run(
            [sys.executable, "-m", "grpc_tools.protoc", f"-I{ROOT / 'proto'}", f"-I{_includes()}",
             "--include_source_info", f"--descriptor_set_out={out}", *map(str, files)],
            check=True,
        )  # fmt: skip
        return descriptor_pb2.FileDescriptorSet.FromString(out.read_bytes())


def describe(file: descriptor_pb2.FileDescriptorProto) -> list[str]:
    """The Markdown of one file: its services first, then enums and messages."""
    comments = {
        tuple(place.path): " ".join(place.leading_comments.split())
        for place in file.source_code_info.location
    }
    lines = [f"## {file.name}", ""]
    for i, service in enumerate(file.service):
        lines += [f"### {service.name}", "", comments.get((_SERVICE, i), ""), ""]
        for k, method in enumerate(service.method):
            lines += _method(method, comments.get((_SERVICE, i, _METHOD, k), ""))
    for i, enum in enumerate(file.enum_type):
        lines += [
            f"### {enum.name}",
            "",
            comments.get((_ENUM, i), ""),
            "",
            "| value | |",
            "|---|---|",
        ]
        lines += [
            f"| `{value.name}` = {value.number} | {comments.get((_ENUM, i, _VALUE, k), '')} |"
            for k, value in enumerate(enum.value)
        ]
        lines.append("")
    for i, message in enumerate(file.message_type):
        lines += [f"### {message.name}", "", comments.get((_MESSAGE, i), ""), ""]
        if message.field:
            lines += ["| field | type | |", "|---|---|---|"]
            lines += [
                f"| `{field.name}` = {field.number} | {_type(field)} "
                f"| {comments.get((_MESSAGE, i, _FIELD, k), '')} |"
                for k, field in enumerate(message.field)
            ]
            lines.append("")
    return lines


def _method(method: descriptor_pb2.MethodDescriptorProto, comment: str) -> list[str]:
    given = ("stream " if method.client_streaming else "") + _short(method.input_type)
    answer = ("stream " if method.server_streaming else "") + _short(method.output_type)
    return [f"#### {method.name}", "", f"`{given}` → `{answer}`", "", comment, ""]


def _type(field: descriptor_pb2.FieldDescriptorProto) -> str:
    name = _short(field.type_name) if field.type_name else _SCALARS[field.type]
    repeated = field.label == descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED
    return f"repeated {name}" if repeated else name


def _short(name: str) -> str:
    return name.removeprefix(".magicslam.v1.").removeprefix(".")


def _includes() -> Path:
    """Where grpc_tools keeps google/protobuf/*.proto."""
    import grpc_tools

    return Path(grpc_tools.__path__[0]) / "_proto"

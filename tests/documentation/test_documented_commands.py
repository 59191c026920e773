"""Every command and option that a page names exists, and every block says how it is shown."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from xml.etree import ElementTree

import pytest
from magicslam.v1 import global_map_service_pb2, mapping_service_pb2, session_service_pb2

from tests.commands import options_of, parse_command
from tests.documentation.pages import (
    PAGES,
    ROOT,
    blocks,
    inline_code,
    magic_commands,
    name_of,
    shell_commands,
)
from tests.documentation.scenes import ELSEWHERE, PARSED, RUN

SVG = "{http://www.w3.org/2000/svg}"
CALLS = {
    method.name
    for contract in (global_map_service_pb2, mapping_service_pb2, session_service_pb2)
    for service in contract.DESCRIPTOR.services_by_name.values()
    for method in service.methods
}
PLACEHOLDER = re.compile(r"\b(COMMAND|NAME|WHAT)\b")
WITH_SETTINGS = ("run", "serve", "agent", "view", "doctor", "check-data", "export", "render",
                 "worker")  # fmt: skip
OF_OTHERS = {
    "--gpus", "--profile", "--runs", "--halts", "--insecure-tokens",
}  # fmt: skip
"""Options of docker and of the fault campaigns that stand in prose."""


def documented() -> Iterator[tuple[str, list[str]]]:
    """Every `magic` command of a block, and of the examples in the commands' own help."""
    for page in PAGES:
        for block in blocks(page):
            if block.language == "bash":
                for line in shell_commands(block.text):
                    for command in magic_commands(line):
                        yield str(block), command
    for path in sorted((ROOT / "magic_cli").rglob("*.py")):
        help_text = ast.get_docstring(ast.parse(path.read_text()), clean=False) or ""
        for line in shell_commands(help_text.partition("Examples:")[2]):
            if re.match(r"(\w+=\S+ )?magic ", line) and not PLACEHOLDER.search(line):
                for command in magic_commands(line):
                    yield name_of(path), command


def mentioned() -> Iterator[tuple[str, list[str]]]:
    """Every `magic ...` in the prose of a page, which may leave out what a command needs."""
    for page in PAGES:
        for code in inline_code(page):
            if re.match(r"(\S*/)?magic [a-z]", code):
                for command in magic_commands(code):
                    yield name_of(page), command


@functools.cache
def parsed(command: tuple[str, ...]) -> None:
    """Read a command line; a config file that only its reader has is left out."""
    words = list(command)
    if "--config" in words and not (ROOT / words[words.index("--config") + 1]).exists():
        del words[words.index("--config") : words.index("--config") + 2]
    parse_command(["." if word == "/mnt/magic" else word for word in words])  # must be a folder


@functools.cache
def known_options(name: tuple[str, ...]) -> set[str]:
    return options_of(*name) | {"--config", "--help", "--help-all"}


def test_every_command_of_a_block_and_of_help_is_understood(monkeypatch) -> None:
    monkeypatch.chdir(ROOT)
    found = list(documented())
    assert len(found) > 60
    wrong = []
    for where, command in found:
        try:
            parsed(tuple(command))
        except AssertionError as error:
            wrong.append(f"{where}: {error}")
    assert not wrong, "\n".join(wrong)


def test_every_command_of_the_prose_exists_with_its_options() -> None:
    found = list(mentioned())
    assert len(found) > 30
    for where, command in found:
        nested = command[0] in ("bench", "sessions", "posegraph")
        name = tuple(command[: 2 if nested else 1])
        options = {word for word in command if word.startswith("--")}
        unknown = options - known_options(name)
        assert not unknown, f"{where}: magic {' '.join(name)} has no {unknown}"


def test_every_option_that_a_page_names_exists() -> None:
    known = set().union(*(known_options((name,)) for name in WITH_SETTINGS))
    wrong = [
        f"{name_of(page)}: {option}"
        for page in PAGES
        for code in inline_code(page)
        if code.startswith("--")
        for option in re.findall(r"(?<!\S)--[a-z][\w.-]*", code)
        if option not in known and option not in OF_OTHERS
    ]
    assert not wrong, wrong


def test_every_block_is_run_or_says_why_not() -> None:
    for page in PAGES:
        for block in blocks(page):
            ways = [
                block.reason is not None,
                block.language in RUN or block.file is not None,
                (block.page, block.language) in PARSED,
                (block.page, block.language) in ELSEWHERE,
            ]
            assert any(ways), f"{block}: neither run nor marked <!-- not run: REASON -->"
            if block.reason is not None:
                assert len(block.reason) > 10, f"{block}: {block.reason!r} is no reason"
            assert block.language, f"{block}: no language is named"


def test_tests_that_run_a_block_elsewhere_read_its_page() -> None:
    for (page, _), test in ELSEWHERE.items():
        assert page.rpartition("/")[2] in (ROOT / test).read_text()


@pytest.mark.parametrize(("page", "language"), sorted(PARSED))
def test_data_in_a_page_are_what_they_claim_to_be(page: str, language: str, tmp_path) -> None:
    found = [block for block in blocks(ROOT / page) if block.language == language]
    assert found
    for block in found:
        PARSED[page, language](block.text, tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith(("http://", "https://")):
            assert (page.parent / target).exists(), f"{name_of(page)}: {target}"


@pytest.mark.parametrize("path", sorted((ROOT / "docs").rglob("*.svg")), ids=name_of)
def test_a_diagram_needs_no_network_and_names_real_calls(path) -> None:
    drawing = ElementTree.parse(path)
    for element in drawing.iter():
        for attribute, value in element.attrib.items():
            assert "href" not in attribute, f"{name_of(path)}: {value} lies elsewhere"
    called = [e.text for e in drawing.iter(f"{SVG}text") if e.get("class") == "call"]
    assert called
    assert set(called) <= CALLS


def test_no_page_is_drawn_by_a_script_from_elsewhere() -> None:
    for page in PAGES:
        assert "mermaid" not in {block.language for block in blocks(page)}, name_of(page)

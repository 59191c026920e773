"""What README.md and docs/ tell people to type works: every block runs, in order, page by page.

What stands for what is declared in tests/documentation/scenes.py.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

from magic_agent.places.model import cache_folder
from magic_core.data import write_replica
from magic_core.data.synthetic import SyntheticConfig, synthetic_flat
from magic_core.render.jit import kernel_cache_folder
from tests.documentation.pages import PAGES, ROOT, Block, blocks, name_of, shell_commands
from tests.documentation.scenes import BEFORE, ELSEWHERE, PARSED, STAYS, replaced

pytestmark = pytest.mark.slow

PACKAGES = ("magic_core", "magic_agent", "magic_server", "magic_cli")
LINKED = ("deploy", "docs", "proto", "scripts", "Makefile", "pyproject.toml", "constraints.txt")
PATIENCE_S = 900


@pytest.fixture(scope="module")
def office(tmp_path_factory) -> Path:
    """A recording per agent, as somebody would have it in a folder of their own."""
    config = SyntheticConfig(agents=2, frames=24, width=320, height=240, detail="draft")
    return write_replica(synthetic_flat(config), tmp_path_factory.mktemp("recordings") / "office")


def write_encoder(path: Path) -> None:
    """A small image encoder: the means of a few random convolutions, as an ONNX file."""
    weights = np.random.default_rng(1).normal(size=(32, 3, 16, 16)).astype(np.float32)
    graph = onnx.helper.make_graph(
        [
            onnx.helper.make_node("Conv", ["image", "weights"], ["edges"], strides=[16, 16]),
            onnx.helper.make_node("Relu", ["edges"], ["seen"]),
            onnx.helper.make_node("Reshape", ["seen", "shape"], ["flat"]),
            onnx.helper.make_node("Transpose", ["flat"], ["tokens"], perm=[0, 2, 1]),
        ],
        "encoder",
        [onnx.helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, [1, 3, 224, 224])],
        [onnx.helper.make_tensor_value_info("tokens", onnx.TensorProto.FLOAT, [1, 196, 32])],
        [
            onnx.numpy_helper.from_array(weights, "weights"),
            onnx.numpy_helper.from_array(np.array([1, 32, 196]), "shape"),
        ],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    model.ir_version = 9
    onnx.save(model, path)


class Reader:
    """Somebody who types what a page says, in a folder that looks like a clone."""

    def __init__(self, folder: Path, office: Path, *, changes_source: bool) -> None:
        self.folder = folder
        for name in LINKED:
            (folder / name).symlink_to(ROOT / name)
        (folder / ".venv").symlink_to(sys.prefix)
        ignored = shutil.ignore_patterns("node_modules", "build", "__pycache__")
        shutil.copytree(ROOT / "examples", folder / "examples", ignore=ignored)
        shutil.copytree(office, folder / "recordings" / "office")
        write_encoder(folder / "encoder.onnx")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        self._environment = {
            **os.environ,
            "HOME": str(folder),
            "PATH": f"{sys.prefix}/bin:{os.environ['PATH']}",
            "MAGIC_CACHE_DIR": str(cache_folder()),
            "MAGIC_KERNEL_CACHE": str(kernel_cache_folder()),
        }
        if changes_source:
            for name in PACKAGES:
                shutil.copytree(ROOT / name, folder / name, ignore=ignored)
            self._environment["PYTHONPATH"] = str(folder)
        self._staying: dict[str, subprocess.Popen[str]] = {}

    def follow(self, block: Block) -> None:
        """Do what a block says."""
        text = replaced(block.text, port=self.port)
        if block.file is not None:
            (self.folder / block.file).write_text(block.text)
        elif block.language == "bash":
            self.type(text, where=str(block))
        elif block.language == "diff":
            (self.folder / "change.diff").write_text(block.text)
            self._run(["patch", "-p1", "-F0", "-i", "change.diff"], where=str(block))
        else:
            (self.folder / "block.py").write_text(text)
            self._run([sys.executable, "block.py"], where=str(block))

    def type(self, text: str, *, where: str) -> None:
        """Run the lines of a script; what stays is awaited and left running."""
        script: list[str] = []
        for line in shell_commands(text):
            if STAYS.match(line):
                self._run_script(script, where=where)
                self._start(line, where=where)
            else:
                script.append(line)
        self._run_script(script, where=where)

    def leave(self) -> None:
        """Stop what still runs."""
        for name in list(self._staying):
            self._stop(name)

    def _run_script(self, lines: list[str], *, where: str) -> None:
        if lines:
            # -x: the last command that is shown is the one that failed
            self._run(["bash", "-xeuo", "pipefail", "-c", "\n".join(lines)], where=where)
            lines.clear()

    def _run(self, command: list[str], *, where: str) -> None:
        """Run a command to its end; a failure shows what it printed, and what servers did."""
        process = subprocess.Popen(
            command, cwd=self.folder, env=self._environment, stdin=subprocess.DEVNULL, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            printed, _ = process.communicate(timeout=PATIENCE_S)
            ended = f"exit code {process.returncode}"
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            printed, _ = process.communicate()
            ended = f"not done after {PATIENCE_S} s"
        assert ended == "exit code 0", f"{where}: {ended}\n{printed[-6000:]}\n{self._server_logs()}"

    def _start(self, line: str, *, where: str) -> None:
        name = " ".join(line.split()[:2])
        self._stop(name)  # a page that starts another server means this one
        log = self._log_of(name)
        with log.open("w") as messages:
            process = subprocess.Popen(
                ["bash", "-c", f"exec {line.split('#')[0]}"], cwd=self.folder,
                env=self._environment, stdout=subprocess.PIPE, stderr=messages, text=True,
                start_new_session=True,
            )  # fmt: skip
        self._staying[name] = process
        assert process.stdout is not None
        first = process.stdout.readline()
        assert first, f"{where}: {line} ended at once with {process.wait()}\n{log.read_text()}"
        assert json.loads(first)["ready"], where

    def _log_of(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.log"

    def _server_logs(self) -> str:
        """How the logs of what stays end."""
        parts = [f"== {name}\n{self._log_of(name).read_text()[-3000:]}" for name in self._staying]
        return "\n".join(parts)

    def _stop(self, name: str) -> None:
        process = self._staying.pop(name, None)
        if process is None:
            return
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            assert process.stdout is not None
            process.stdout.close()


def to_follow(page: Path) -> list[Block]:
    """The blocks of a page that are run here."""
    return [
        block
        for block in blocks(page)
        if block.reason is None
        and (block.page, block.language) not in PARSED
        and (block.page, block.language) not in ELSEWHERE
    ]


@pytest.mark.parametrize("page", [page for page in PAGES if to_follow(page)], ids=name_of)
def test_what_a_page_says_works(page: Path, office: Path, tmp_path: Path) -> None:
    followed = to_follow(page)
    if any("npm" in block.text for block in followed) and shutil.which("npm") is None:
        pytest.skip("Node.js is not installed")
    changes = any(block.language == "diff" for block in followed)
    reader = Reader(tmp_path, office, changes_source=changes)
    try:
        for line in BEFORE.get(name_of(page), ()):
            reader.type(replaced(line, port=reader.port), where="before")
        for block in followed:
            reader.follow(block)
    finally:
        reader.leave()

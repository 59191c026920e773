"""Threads and processes: concurrent callers, fork and spawn, shares of the machine, the cache."""

import logging
import multiprocessing
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from magic_core.errors import ConfigError
from magic_core.gaussians import GaussianCloud
from magic_core.geometry import Camera
from magic_core.render import Rasteriser, jit, threads, warm_up
from magic_core.render.benchmark import Subject

CELL = (70, 50, 1500)


def render_and_differentiate(count):
    subject = Subject.of(CELL, count)
    view = subject.rasteriser.render(subject.cloud, subject.camera, np.eye(4))
    return view.image, subject.rasteriser.backward(subject.gradient).means


def _child(queue):
    image, means = render_and_differentiate(2)
    queue.put((image, means))


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_renders_in_child_processes_after_rendering_in_the_parent(method):
    expected = render_and_differentiate(2)
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    child = context.Process(target=_child, args=(queue,))
    child.start()
    found = queue.get(timeout=120)
    child.join(60)
    assert child.exitcode == 0
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_array_equal(a, b)


def test_four_callers_at_once_beside_torch_and_open3d():
    import open3d  # noqa: F401
    import torch

    expected = render_and_differentiate(1)
    failures = []

    def work():
        assert float((torch.ones(200, 200) @ torch.ones(200, 200))[0, 0]) == 200
        for _ in range(5):
            found = render_and_differentiate(3)
            same = all(np.array_equal(a, b) for a, b in zip(expected, found, strict=True))
            failures.extend([] if same else ["differs"])

    callers = [threading.Thread(target=work) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(120)
    assert not any(caller.is_alive() for caller in callers)
    assert failures == []


def test_gradients_are_equal_for_one_and_for_several_threads_every_time():
    # No tile is opaque and no pair is dropped, so that the lists of neighbouring tiles touch: a
    # thread that writes past its own tile spoils another's.
    rng = np.random.default_rng(0)
    camera = Camera(width=96, height=72, fx=84.0, fy=84.0, cx=47.5, cy=35.5)
    n = 4000
    depth = rng.uniform(1.0, 4.0, n)
    pixels = rng.uniform([-0.5, -0.5], [95.5, 71.5], (n, 2))
    means = np.stack(
        [(pixels[:, 0] - 47.5) / 84 * depth, (pixels[:, 1] - 35.5) / 84 * depth, depth], axis=1
    )
    cloud = GaussianCloud.from_arrays(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        scales=np.repeat(0.01 * depth[:, None], 3, axis=1),
        opacities=np.full(n, 0.3),
        colours=rng.uniform(0, 1, (n, 3)),
    )
    gradient = rng.normal(size=(5, 72, 96)).astype(np.float32)
    single, several = Rasteriser(1), Rasteriser(3)
    single.render(cloud, camera, np.eye(4))
    expected = single.backward(gradient)
    for _ in range(150):
        several.render(cloud, camera, np.eye(4))
        found = several.backward(gradient)
        assert np.array_equal(found.means, expected.means)
        assert np.array_equal(found.colours, expected.colours)


def test_every_piece_is_done_once_by_some_thread():
    done = np.zeros(5000, np.int64)

    def kernel(claimed, lock, out):
        while True:
            with lock:  # a Python stand-in for the atomic claim
                piece = claimed[0]
                claimed[0] += 1
            if piece >= len(out):
                return
            out[piece] += 1

    threads.run(kernel, (threading.Lock(), done), threads=4)
    assert (done == 1).all()


def test_an_error_in_any_thread_reaches_the_caller():
    barrier = threading.Barrier(2, timeout=20)

    def kernel(claimed):
        barrier.wait()
        if threading.current_thread() is not threading.main_thread():
            raise ZeroDivisionError("in a helper")

    with pytest.raises(ZeroDivisionError, match="in a helper"):
        threads.run(kernel, (), threads=2)


def test_magic_threads_sets_the_number(monkeypatch):
    monkeypatch.setenv("MAGIC_THREADS", "3")
    assert Rasteriser().threads == 3
    assert Rasteriser(5).threads == 5
    monkeypatch.setenv("MAGIC_THREADS", "many")
    with pytest.raises(ConfigError, match="MAGIC_THREADS"):
        threads.default_threads()


def test_processes_that_render_share_the_cores(monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(threads.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(threads, "_share", threads._Share())
    monkeypatch.setattr(threads, "available_cores", lambda: 8)
    monkeypatch.delenv("MAGIC_THREADS", raising=False)
    assert threads.default_threads() == 8
    script = (
        "import sys\n"
        "from magic_core.render.threads import rendering_processes\n"
        "print(rendering_processes(), flush=True)\n"
        "sys.stdin.readline()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    ) as other:  # fmt: skip
        assert other.stdout is not None
        assert other.stdin is not None
        assert other.stdout.readline().strip() == "2"
        threads._share.counted_at = -1e9
        assert threads.default_threads() == 4
        other.stdin.write("\n")
        other.stdin.flush()
        other.wait(60)
    threads._share.counted_at = -1e9
    assert threads.default_threads() == 8  # the other has ended; its lock is gone


def test_a_kernel_is_stale_when_any_file_it_imports_changes():
    here = jit.Path(jit.__file__).parent
    files = {path.name for path in jit._imported_files(here / "project_backward.py")}
    assert {"project_backward.py", "project.py", "simd.py", "layout.py", "vecmath.py"} <= files
    assert "optimiser.py" not in files
    assert jit.source_hash("blend") != jit.source_hash("project")


def test_warm_up_tells_what_it_does_and_fills_the_cache(caplog):
    lines = []
    with caplog.at_level(logging.INFO, logger="magic_core.render.jit"):
        report = warm_up(progress=lines.append)
    assert set(report.seconds) == {"render", "gradients", "mapping iteration", "tracking"}
    assert sum(line.startswith("gradients") for line in lines) == 2
    assert report.total_s > 0
    folder = jit.kernel_cache_folder()
    assert folder is not None
    stamp = jit.source_hash("blend")
    assert any(stamp in path.name for path in folder.glob("blend.blend-*.nbi"))

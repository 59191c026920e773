"""Jobs on a Dask cluster: real scheduler and workers as processes, killed where it hurts."""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from magic_cli.main import run_command
from magic_core.errors import ConfigError, CorruptData, Unavailable
from magic_core.gaussians import codec
from magic_core.tracing import TracingConfig
from magic_server.jobs import JobConfig, JobExecutor, new_executor
from magic_server.jobs.cluster.gate import PriorityGate
from magic_server.jobs.config import ClusterTls
from tests.cluster import (
    REPOSITORY,
    Cluster,
    alive,
    merge_submaps,
    note,
    pid_once_there,
    running_cluster,
)
from tests.waiting import eventually

pytest.importorskip("distributed")


OPTIONS = ("--threads", "3")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder, and beside it another path to the same."""
    folder = tmp_path_factory.mktemp("server") / "data"
    folder.mkdir()
    folder.with_name("mounted").symlink_to(folder)
    return folder


@pytest.fixture(scope="module")
def cluster(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A scheduler and a worker that has the data folder under another path."""
    with running_cluster(tmp_path_factory.mktemp("cluster")) as running:
        running.start_worker("first", *OPTIONS, "--data-dir", str(data.with_name("mounted")))
        yield running


@asynccontextmanager
async def dask_jobs(cluster: Cluster, folder: Path, **settings) -> AsyncIterator[JobExecutor]:
    """A started executor on the cluster, for a data folder."""
    config = JobConfig(executor="dask", scheduler=cluster.address, **settings)
    jobs = new_executor(config, folder=folder, trace=TracingConfig(), observer=lambda *_: None)
    await jobs.start()
    try:
        yield jobs
    finally:
        await jobs.close()


async def test_jobs_give_their_results_their_errors_and_their_files(
    cluster: Cluster, data: Path, tmp_path: Path
) -> None:
    async with dask_jobs(cluster, data) as jobs:
        assert await jobs.run(divmod, 17, 5) == (3, 2)
        assert await jobs.run(os.getenv, "MAGIC_THREADS") == "3"
        with pytest.raises(ZeroDivisionError) as plain:
            await jobs.run(divmod, 17, 0)
        assert "run_job" in str(plain.value.__cause__)
        with pytest.raises(CorruptData, match="starts with") as ours:
            await jobs.run(codec.decode, b"nothing of ours")
        assert ours.value.grpc_code == "DATA_LOSS"
        # A path under the data folder is read where the worker has that folder, and comes back.
        inside, outside = data / "a" / "file", tmp_path / "other"
        assert await jobs.run(os.fspath, inside) == str(data.with_name("mounted") / "a" / "file")
        assert await jobs.run(os.fspath, outside) == str(outside)
        assert await jobs.run(Path.absolute, inside) == inside
        assert jobs.slots == 1


async def test_urgent_jobs_overtake_merges_and_a_given_up_job_ends_at_once(
    cluster: Cluster, data: Path
) -> None:
    order, go = data / "order", data / "never"
    async with dask_jobs(cluster, data) as jobs:
        holding = asyncio.create_task(jobs.run(pid_once_there, go))
        await eventually(go.with_suffix(".waiting").exists)
        waiting = [
            asyncio.create_task(jobs.run(job, order, f"{job.__name__} {number}"))
            for job in (merge_submaps, note)
            for number in range(3)
        ]
        await asyncio.sleep(0.5)
        assert jobs.waiting == 6
        holding.cancel()
        await asyncio.gather(*waiting)
        assert not alive(waited(go)[0])
    assert order.read_text().splitlines() == [
        "note 0", "note 1", "note 2", "merge_submaps 0", "merge_submaps 1", "merge_submaps 2",
    ]  # fmt: skip


async def test_a_crashed_process_costs_its_job_and_a_killed_worker_only_time(
    cluster: Cluster, data: Path
) -> None:
    go = data / "go"
    cluster.start_worker("second", *OPTIONS, "--data-dir", str(data), wait=False)
    async with dask_jobs(cluster, data) as jobs:
        with pytest.raises(Unavailable, match="died twice during _exit"):
            await jobs.run(os._exit, 1)
        assert await jobs.run(divmod, 7, 2) == (3, 1)
        running = asyncio.create_task(jobs.run(pid_once_there, go))
        await eventually(go.with_suffix(".waiting").exists)
        cluster.wait_joined("second")
        cluster.kill(cluster.owner_of(waited(go)[0]))
        await eventually(lambda: len(waited(go)) == 2)
        go.touch()
        assert await running == waited(go)[1] != waited(go)[0]


def waited(go: Path) -> list[int]:
    """The processes in which `pid_once_there` was begun."""
    return [int(line) for line in go.with_suffix(".waiting").read_text().split()]


@pytest.mark.slow
async def test_workers_that_do_not_see_the_data_folder_are_given_nothing(tmp_path: Path) -> None:
    with running_cluster(tmp_path / "cluster") as cluster:
        await _one_astray(cluster, tmp_path)


async def _one_astray(cluster: Cluster, tmp_path: Path) -> None:
    mine, others = tmp_path / "mine", tmp_path / "others"
    mine.mkdir()
    others.mkdir()
    (others / "cluster-id").write_text("another server's")
    cluster.start_worker("astray", "--data-dir", str(others))
    async with dask_jobs(cluster, mine, connect_timeout_s=2.0) as jobs:
        waiting = asyncio.create_task(jobs.run(divmod, 9, 4))
        with pytest.raises(Unavailable, match="folder of another server; mount the server's data"):
            await jobs.run(localize_image)
        shutil.copy(mine / "cluster-id", others)  # as if it were mounted now
        assert not waiting.done()
        cluster.start_worker("there", "--resources", "gpu=1")
        assert await waiting == (2, 1)


def localize_image() -> None:
    """Never runs: as impatient as the job of that name."""


@pytest.mark.slow
async def test_a_scheduler_that_is_started_again_gets_the_jobs_again(tmp_path: Path) -> None:
    with running_cluster(tmp_path / "cluster") as cluster:
        cluster.start_worker("loyal")
        async with dask_jobs(cluster, tmp_path, connect_timeout_s=2.0) as jobs:
            running = asyncio.create_task(jobs.run(pid_once_there, tmp_path / "go"))
            await eventually((tmp_path / "go.waiting").exists)
            cluster.kill("scheduler")
            with pytest.raises(Unavailable, match=r"start one there \(dask scheduler --port"):
                await jobs.run(localize_image)
            queued = asyncio.create_task(jobs.run(divmod, 9, 4))
            cluster.start_scheduler()
            cluster.wait_joined("loyal", times=2)
            await eventually(lambda: len(waited(tmp_path / "go")) == 2)
            (tmp_path / "go").touch()
            assert await running == waited(tmp_path / "go")[1]
            assert not alive(waited(tmp_path / "go")[0])
            assert await queued == (2, 1)


@pytest.mark.slow
async def test_a_worker_that_is_told_to_stop_ends_its_job_and_leaves_in_peace(
    tmp_path: Path,
) -> None:
    with running_cluster(tmp_path / "cluster") as cluster:
        cluster.start_worker("tired")
        async with dask_jobs(cluster, tmp_path) as jobs:
            running = asyncio.create_task(jobs.run(pid_once_there, tmp_path / "go"))
            await eventually((tmp_path / "go.waiting").exists)
            tired = cluster.workers.pop("tired")
            tired.terminate()
            assert await asyncio.to_thread(tired.wait, 30.0) == 0
            assert not alive(waited(tmp_path / "go")[0])
            (tmp_path / "go").touch()
            cluster.start_worker("rested")
            assert await running == waited(tmp_path / "go")[1]


@pytest.mark.slow
def test_a_worker_ends_when_told_to_whether_or_not_there_is_a_scheduler(tmp_path: Path) -> None:
    with running_cluster(tmp_path / "cluster") as cluster:
        for name in ("one", "two"):
            cluster.start_worker(name)
        one, two = (cluster.workers.pop(name) for name in ("one", "two"))
        assert cluster.scheduler is not None
        cluster.scheduler.terminate()
        one.terminate()
        assert one.wait(120.0) == 0
        cluster.scheduler.wait(120.0)
        two.terminate()
        assert two.wait(120.0) == 0


@pytest.mark.slow
async def test_a_server_that_is_killed_leaves_no_job_running(tmp_path: Path) -> None:
    script = (
        "import asyncio, sys\n"
        "from pathlib import Path\n"
        "from tests.server.test_jobs_cluster import dask_jobs\n"
        "from tests.cluster import pid_once_there\n"
        "class There: address = sys.argv[1]\n"
        "async def main():\n"
        "    async with dask_jobs(There, Path(sys.argv[2])) as jobs:\n"
        "        await jobs.run(pid_once_there, Path(sys.argv[2]) / 'go')\n"
        "asyncio.run(main())\n"
    )
    with running_cluster(tmp_path / "cluster") as cluster:
        cluster.start_worker("loyal")
        server = await asyncio.create_subprocess_exec(
            sys.executable, "-c", script, cluster.address, str(tmp_path), cwd=REPOSITORY
        )
        await eventually((tmp_path / "go.waiting").exists, timeout_s=60.0)
        server.kill()
        await server.wait()
        await eventually(lambda: not alive(waited(tmp_path / "go")[0]))


@pytest.mark.slow
async def test_merges_wait_for_the_workers_that_are_set_aside_for_them(tmp_path: Path) -> None:
    with running_cluster(tmp_path / "cluster") as cluster:
        cluster.start_worker("plain")
        async with dask_jobs(cluster, tmp_path, merge_resources="gpu=1") as jobs:
            merges = [
                asyncio.create_task(jobs.run(merge_submaps, tmp_path / "notes", "merged"))
                for _ in range(3)
            ]
            assert await jobs.run(divmod, 9, 4) == (2, 1)
            await asyncio.sleep(1.0)
            assert not (tmp_path / "notes").exists()
            cluster.start_worker("strong", "--resources", "gpu=1")
            assert await asyncio.gather(*merges) == ["merged"] * 3


@pytest.mark.slow
async def test_certificates_keep_strangers_out(tmp_path: Path) -> None:
    import trustme

    authority, stranger = trustme.CA(), trustme.CA()
    files = {}
    for name, signer in (("ours", authority), ("theirs", stranger)):
        issued = signer.issue_cert("127.0.0.1")
        files[name] = [tmp_path / f"{name}-{part}.pem" for part in ("ca", "certificate", "key")]
        signer.cert_pem.write_to_path(files[name][0])
        issued.cert_chain_pems[0].write_to_path(files[name][1])
        issued.private_key_pem.write_to_path(files[name][2])
    ca, certificate, key = map(str, files["ours"])
    options = ("--tls-ca-file", ca, "--tls-cert", certificate, "--tls-key", key)
    with running_cluster(tmp_path / "cluster", scheme="tls", options=options) as cluster:
        cluster.start_worker(
            "ours", "--tls.ca", ca, "--tls.certificate", certificate, "--tls.key", key
        )
        async with dask_jobs(cluster, tmp_path, tls=ClusterTls(*files["ours"])) as jobs:
            assert await jobs.run(divmod, 17, 5) == (3, 2)
        theirs = ClusterTls(*files["theirs"])
        async with dask_jobs(cluster, tmp_path, tls=theirs, connect_timeout_s=2.0) as jobs:
            with pytest.raises(Unavailable, match="no Dask scheduler can be used at tls://"):
                await jobs.run(localize_image)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"executor": "dask"}, "expected tcp://HOST:PORT"),
        ({"executor": "dask", "scheduler": "10.0.0.5:8786"}, "expected tcp://HOST:PORT"),
        ({"executor": "dask", "scheduler": "tcp://h:70000"}, "expected tcp://HOST:PORT"),
        ({"executor": "dask", "scheduler": "tls://h:8786"}, "needs jobs.tls.ca"),
        ({"scheduler": "tcp://h:8786"}, "give jobs.executor dask as well"),
        ({"merge_resources": "gpu=many"}, "expected NAME=AMOUNT, for instance gpu=1"),
        ({"in_flight": 0}, "expected at least 1"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings: dict, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        JobConfig(**settings)


def test_without_dask_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)  # as if it were not installed
    config = JobConfig(executor="dask", scheduler="tcp://h:8786")
    with pytest.raises(ConfigError, match=r"pip install 'magic-slam\[cluster\]'"):
        new_executor(config, folder=tmp_path, trace=TracingConfig(), observer=lambda *_: None)
    pool = new_executor(
        JobConfig(), folder=tmp_path, trace=TracingConfig(), observer=lambda *_: None
    )
    assert pool.slots == 2


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["10.0.0.5:8786"], "expected tcp://HOST:PORT"),
        (["tls://h:8786"], "needs tls.ca, .certificate and .key"),
        (["tcp://h:8786", "--resources", "gpu"], "expected NAME=AMOUNT"),
        (["tcp://h:8786", "--data-dir", "nowhere"], "mount or make it first"),
        (["tcp://h:8786", "--processes", "0"], "processes and threads are at least 1"),
    ],
)
def test_a_worker_that_cannot_work_says_so_at_once(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["worker", *arguments]) == 2
    assert complaint in capsys.readouterr().err


def test_certificates_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("ca.pem", "certificate.pem", "key.pem")]
    config = JobConfig(executor="dask", scheduler="tls://h:8786", tls=ClusterTls(*files))
    with pytest.raises(ConfigError, match=r"certificate\.pem .* expected PEM files"):
        new_executor(config, folder=tmp_path, trace=TracingConfig(), observer=lambda *_: None)


async def test_a_gate_keeps_its_bound_its_order_and_forgets_who_gave_up() -> None:
    gate = PriorityGate(most=3)
    inside: list[int] = []
    leave = asyncio.Event()

    async def visit(priority: int) -> None:
        async with gate.turn(priority, ahead=2):
            inside.append(priority)
            await leave.wait()

    visits = [asyncio.create_task(visit(priority)) for priority in (1, 5, 3, 5, 2)]
    await asyncio.sleep(0)
    assert not inside
    assert gate.waiting == 5
    visits[1].cancel()
    await asyncio.gather(visits[1], return_exceptions=True)
    gate.set_slots(1)
    await eventually(lambda: len(inside) == 2)
    await asyncio.sleep(0.01)
    assert inside == [5, 3]
    gate.set_slots(8)  # no more than `most`
    await eventually(lambda: len(inside) == 3)
    await asyncio.sleep(0.01)
    assert inside == [5, 3, 2]
    leave.set()
    await asyncio.gather(*(visits[i] for i in (0, 2, 3, 4)))
    assert inside == [5, 3, 2, 1]

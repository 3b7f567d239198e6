"""`bodycap batch --executor tcp://…`: a real scheduler and real workers, each a process on loopback.

`make test-cluster` runs all of them, `make test-slow` (and so CI) those marked slow: a worker killed, a
scheduler lost, a job that crashes, two tasks too large for one worker.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.site import NAMES, REAL, Site, wait_for
from tests.pipeline.tiny_job import JOB
from tests.processes import gone

pytestmark = pytest.mark.cluster


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    site.captures()
    try:
        yield site
    finally:
        site.close()


def test_two_workers_give_the_same_as_this_machine(site: Site) -> None:
    address = site.scheduler()
    site.worker("one")
    site.worker("two")
    code, out, err = site.run(*NAMES, "--executor", address)
    assert code == 0, err
    assert out.splitlines()[-1] == "3 of 3 jobs done"
    assert site.run(*NAMES, "--out", "here")[0] == 0
    assert site.results() == site.results("here")
    code, out, _ = site.run(*NAMES, "--executor", address)
    assert (code, out.count("nothing to do")) == (0, 3)


@pytest.mark.slow
def test_a_killed_workers_task_is_done_elsewhere_with_the_same_bytes(site: Site) -> None:
    assert site.run(*NAMES, "--out", "here")[0] == 0
    address = site.scheduler()
    site.worker("one")
    site.worker("two")
    site.order(hang="map", on="tuesday")
    process = site.start(*NAMES, "--executor", address)
    child = site.hanging()
    killed = site.worker_of(child)
    site.order()
    site.kill(killed)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    assert out.splitlines()[-1] == "3 of 3 jobs done"
    wait_for(lambda: gone(child), "the end of the killed worker's child")
    assert site.results() == site.results("here")
    assert killed not in site.processes


def test_a_task_that_kills_two_workers_is_given_up_and_the_other_jobs_are_done(site: Site) -> None:
    address = site.scheduler()
    for name in ("one", "two", "three"):
        site.worker(name)
    site.order(hang="map", on="tuesday")
    process = site.start(*NAMES, "--executor", address)
    first = site.hanging()
    site.kill(site.worker_of(first))
    second = site.hanging(other_than=first)
    site.kill(site.worker_of(second))
    out, err = process.communicate(timeout=200)
    assert process.returncode == 70, err
    rows = {line.split()[0]: line for line in out.splitlines()}
    assert "2 workers ended unexpectedly while they ran this stage" in rows["tuesday"]
    assert out.splitlines()[-1] == "2 of 3 jobs done"


@pytest.mark.slow
def test_a_crash_and_a_refusal_end_their_jobs_only(site: Site) -> None:
    address = site.scheduler()
    site.worker("one")
    site.order(crash="map", on="tuesday")
    code, out, err = site.run(*NAMES, "--executor", address)
    assert code == 70
    assert "SIGSEGV" in err
    assert out.splitlines()[-1] == "2 of 3 jobs done"
    site.order(fail="map", on="tuesday")
    code, out, err = site.run(*NAMES, "--executor", address)
    assert code == 4
    assert "map does not work out" in err
    assert "hint: film more" in err


@pytest.mark.slow
def test_after_the_scheduler_is_lost_the_batch_goes_on_with_another(site: Site) -> None:
    address = site.scheduler()
    site.worker("one")
    site.order(hang="map")
    process = site.start(*NAMES, "--executor", address)
    child = site.hanging()
    site.kill("scheduler")
    _, err = process.communicate(timeout=200)
    assert process.returncode == 5, err
    assert "the scheduler was lost" in err
    assert "Traceback" not in err
    site.close()
    wait_for(lambda: gone(child), "the end of the lost worker's child")
    site.order()
    address = site.scheduler()
    site.worker("one")
    code, _, err = site.run(*NAMES, "--executor", address)
    assert code == 0, err
    assert "keyframes torso: already done" in err


def test_a_stopped_batch_ends_its_task_on_the_worker(site: Site) -> None:
    address = site.scheduler()
    site.worker("one")
    site.order(hang="map")
    process = site.start(*NAMES, "--executor", address)
    child = site.hanging()
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    wait_for(lambda: gone(child), "the end of the child", 10)
    site.order()
    assert site.run(*NAMES, "--executor", address)[0] == 0, "the worker takes further tasks"


@pytest.mark.slow
def test_two_large_tasks_do_not_meet_on_a_small_worker_though_it_comes_late(site: Site) -> None:
    address = site.scheduler()
    site.order(hang="map")
    process = site.start("monday", "tuesday", "--executor", address, "--json")
    assert process.stderr is not None
    assert process.stdout is not None
    assert "no worker is connected yet" in process.stderr.readline()
    site.worker("one", "--nthreads", "2", "--resources", "memory=2000")  # a map declares 1,500 MB
    started_jobs = set()
    while len(started_jobs) < 2:
        event = json.loads(process.stdout.readline())
        if (event.get("stage"), event["kind"]) == ("map", "started"):  # handed over; it may still wait
            started_jobs.add(event["job"])
    child = site.hanging()
    time.sleep(3.0)  # the other job's map would start in a tenth of that
    assert site.hanging() == child, "the other job's map waits"
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)


def test_a_missing_scheduler_is_reported_with_advice(site: Site) -> None:
    code, _, err = site.run("monday", "--executor", "tcp://127.0.0.1:9")
    assert code == 2
    assert "no scheduler answers at tcp://127.0.0.1:9" in err
    assert "dask worker" in err


def test_the_link_can_be_encrypted(site: Site) -> None:
    key, certificate = site.folder / "key.pem", site.folder / "cert.pem"
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=127.0.0.1",
         "-keyout", str(key), "-out", str(certificate)],
        check=True,
        capture_output=True,
    )  # fmt: skip
    secrets = {"ca-file": certificate, "scheduler__cert": certificate, "scheduler__key": key}
    secrets |= {f"{who}__{what}": path for who in ("worker", "client")
                for what, path in (("cert", certificate), ("key", key))}  # fmt: skip
    secure = {
        f"DASK_DISTRIBUTED__COMM__TLS__{name.upper().replace('-', '_')}": str(path)
        for name, path in secrets.items()
    }
    plain = dict(site.environment)
    site.environment |= {**secure, "DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "true"}
    address = site.scheduler("--protocol", "tls")
    assert address.startswith("tls://")
    site.worker("one")
    code, out, err = site.run("monday", "--executor", address)
    assert code == 0, err
    assert out.splitlines()[-1] == "1 of 1 jobs done"
    site.environment = plain
    code, _, err = site.run("monday", "--executor", address)
    assert code == 2, "a client without certificates is refused"
    assert "no certificates for the connection to tls://" in err


def test_real_stages_with_a_worker_killed_give_the_bytes_of_one_machine(tmp_path: Path) -> None:
    site = Site(tmp_path)
    try:
        (tmp_path / "tiny.yaml").write_text(JOB)
        code, _, err = site.run("tiny.yaml", "--out", "here", command=REAL)
        assert code == 0, err
        address = site.scheduler()
        site.worker("one")
        site.worker("two")
        process = site.start("tiny.yaml", "--executor", address, "--json", command=REAL)
        assert process.stdout is not None
        for line in process.stdout:
            event = json.loads(line)
            if (event["kind"], event.get("stage")) == ("progress", "registration"):
                break
        else:
            pytest.fail("registration never began")
        site.kill("one")
        rest, err = process.communicate(timeout=200)
        assert process.returncode == 0, err
        assert json.loads(rest.splitlines()[-1])["kind"] == "job"
        mine, theirs = site.results(), site.results("here")
        assert mine.keys() == theirs.keys()
        assert [name for name in mine if mine[name] != theirs[name]] == []
    finally:
        site.close()


def test_a_queue_starts_workers(site: Site) -> None:
    """Dask-Jobqueue's own stand-in for a machine room's queue: its job scripts run here."""
    from bodycap_batch.runner.dask_cluster import Cluster, start_queue

    with start_queue("local", 1, 1, 1600) as queue, Cluster(queue.scheduler_address) as cluster:
        found = wait_for(cluster.workers, "a worker of the queue")
        assert [resources["memory"] for resources in found.values()] == [1600]

"""Eight virtual devices, and two processes, give what one device gives."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parents[1]


def start(*arguments, devices):
    """Start a process with so many virtual devices: that is decided before JAX starts."""
    environment = os.environ | {
        "PYTHONPATH": f"{HERE.parent}{os.pathsep}{HERE}",
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}",
        "JAX_COMPILATION_CACHE_DIR": str(HERE.parent / ".pytest_cache" / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
    }
    command = [sys.executable, str(HERE / "work_on_devices.py"), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(processes, timeout):
    """Return what the processes print; none of them outlives this."""
    try:
        outputs = [process.communicate(timeout=timeout) for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, (_, errors) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, errors
    return [json.loads(output.splitlines()[-1]) for output, _ in outputs]


@pytest.fixture(scope="module")
def found():
    return finish([start("devices", devices=8)], timeout=500)[0]


@pytest.mark.slow
def test_stencil_products_on_slabs(found):
    assert found["devices"] == 8
    assert max(found["halo"]) < 1e-15


@pytest.mark.slow
def test_a_batch_shared_out_is_the_batch(found):
    assert found["batch"] < 1e-14


@pytest.mark.slow
def test_batches_for_lapack_on_all_devices_at_once(found):
    assert found["inverses"] < 1e-12
    assert found["exponentials"] < 1e-12


def check_eigenpairs(errors):
    assert errors["converged"]
    assert errors["eigenvalues"] < 1e-13
    assert errors["against dense"] < 1e-10
    assert errors["signature"] < 1e-9


@pytest.mark.slow
def test_eigenpairs_on_eight_devices(found):
    check_eigenpairs(found["eigenpairs"])


@pytest.mark.slow
def test_refusals_say_what_was_expected(found):
    for message, expected in zip(
        found["refusals"], ["one axis", "expected arrays of the same length", "one axis"], strict=True
    ):
        assert expected in message


def on_two_processes(mode):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    both = finish([start(mode, index, port, devices=1) for index in range(2)], timeout=500)
    for found in both:
        assert (found["processes"], found["devices"]) == (2, 2)
        assert found["halo"][0] < 1e-15
    return both


@pytest.mark.slow
def test_two_processes_exchange_halos():
    on_two_processes("process")


@pytest.mark.slow
def test_eigenpairs_on_two_processes():
    for found in on_two_processes("all-process"):
        check_eigenpairs(found["eigenpairs"])

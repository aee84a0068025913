"""The engine for clusters that Ray runs: a task for each job, with a GPU or a part of one. Extra `ray`.

Ray sends functions and results as pickles, so every process that its ports accept can run code as the user. A cluster that this
module starts listens at the loopback address and accepts only processes with its token. For other clusters, the owner chooses
whether there is a token.
"""

import os
import secrets
from typing import Any

from warpgs.errors import ResourceError, UsageError, explained, install_extras
from warpgs.folders import private_folder
from warpgs.pipeline.farm.job import Event, FarmJob
from warpgs.pipeline.farm.work import run_job
from warpgs.ranks import listeners, say_what_is_open


class RayEngine:
    """Runs each job as a task of Ray; Ray finds a machine, and starts the task once more if its process dies."""

    name = "ray"

    def __init__(self, device: str, slots: int | None, per_gpu: int, threads: int = 1, address: str | None = None):
        """Connect to a cluster, or start Ray on this machine."""
        address = address or os.environ.get("RAY_ADDRESS") or "local"
        if address == "local":  # Ray asks for a token unless RAY_AUTH_MODE says otherwise; without this it keeps one in ~/.ray
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
            os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # on every system, Ray listens at the loopback address then
        with explained("--engine ray needs Ray, which is not installed", install_extras("ray"), ImportError, UsageError):
            import ray
        self._ray, self._threads = ray, threads
        if not ray.is_initialized():
            _connect(ray, address)
        gpus = 1 / per_gpu if device == "cuda" else 0
        found = ray.cluster_resources()
        self.slots = slots or int(min(found.get("CPU", 0) / threads, found.get("GPU", 0) / gpus if gpus else float("inf")))
        if self.slots < 1:
            raise UsageError(f"no job of {threads} threads, {gpus:g} GPUs fits into Ray's cluster ({found}); lower --threads")
        environment = {"env_vars": {"PYTHONSAFEPATH": "1"}}
        self._options = {"num_cpus": threads, "num_gpus": gpus, "max_retries": 1, "runtime_env": environment}
        self._running: dict[Any, str] = {}
        self._task = ray.remote(**self._options)(run_job)

    def start(self, job: FarmJob) -> None:
        """Send a job."""
        self._running[self._task.remote(job.text(), self._threads)] = job.name

    def wait(self, seconds: float) -> list[Event]:
        """Return the jobs that have ended."""
        ended, _ = self._ray.wait(list(self._running), timeout=seconds)
        return [self._event(self._running.pop(reference), reference) for reference in ended]

    def _event(self, name: str, reference: Any) -> Event:
        try:
            return name, self._ray.get(reference), ""
        except self._ray.exceptions.RayError as e:  # its process died twice, or a record could not be written
            return name, "crashed", str(e).strip().splitlines()[-1]

    def close(self) -> None:
        """Stop all running jobs, and leave the cluster."""
        for reference in self._running:
            self._ray.cancel(reference)  # KeyboardInterrupt there: the fit saves its state
        self._ray.wait(list(self._running), num_returns=len(self._running), timeout=60) if self._running else None
        self._ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    """Join a cluster, or start one with its sockets in a private folder, because Ray's default folders have mode 0777."""
    # The address is never read from ``/tmp/ray``, where other users can write.
    own = {"include_dashboard": False, "_temp_dir": str(private_folder() / "ray")} if address == "local" else {}
    remedy = "set TMPDIR to a folder with a short path" if own else "check RAY_ADDRESS and RAY_AUTH_TOKEN"
    with explained(f"Ray at {address} does not answer", remedy, (OSError, RuntimeError, ValueError), ResourceError):
        ray.init(address=address, log_to_driver=False, logging_level="warning", **own)
    if own:  # where Ray was imported before us it listens at every interface
        say_what_is_open(listeners())

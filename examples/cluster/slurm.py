"""Run a batch on workers that SLURM starts and stops, by dask-jobqueue: python slurm.py missions.toml CERTIFICATES.

Needs `pip install dask-jobqueue` beside the extra `cluster`. The scheduler runs in this program. `--print` shows
the script of a worker's job and starts nothing. `sbatch` with `georef cluster worker` does without this library
(docs/cluster.md).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from dask_jobqueue import SLURMCluster
from distributed import Security

from pipelines.core.child import THIS_PROGRAM, python_command

# Of each worker. Dask's own threads are jobs at a time; the cores belong to the job.
CORES, MEMORY_GB, GPUS = 16, 64, 0


def cluster_with(certificates: Path) -> SLURMCluster:
    """Return a cluster whose machines share a certificate, and which has no worker yet."""
    certificate, key = str(certificates / "cluster.pem"), str(certificates / "cluster.key")
    roles = {
        f"tls_{role}_{part}": path
        for role in ("scheduler", "worker", "client")
        for part, path in (("cert", certificate), ("key", key))
    }
    offer = f"MEMORY={0.9 * MEMORY_GB * 1e9:.0f},CORES={CORES}" + (f",GPU={GPUS}" if GPUS else "")
    return SLURMCluster(
        cores=1,
        processes=1,
        job_cpu=CORES,
        memory=f"{MEMORY_GB}GB",
        walltime="12:00:00",
        job_script_prologue=["export PYTHONSAFEPATH=1"],  # No module comes from the folder of the submission.
        job_extra_directives=[f"--gpus={GPUS}"] if GPUS else [],
        protocol="tls://",
        security=Security(tls_ca_file=certificate, require_encryption=True, **roles),
        scheduler_options={"dashboard_address": "127.0.0.1:0"},
        worker_extra_args=["--resources", offer, "--memory-limit", "0", "--dashboard-address", "127.0.0.1:0"],
    )


def main() -> int:
    """Run the batch; SLURM has as many workers as there are jobs, up to `--most`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("missions", type=Path)
    parser.add_argument("certificates", type=Path)
    parser.add_argument("--most", type=int, default=8)
    parser.add_argument("--print", action="store_true", dest="only_print")
    asked = parser.parse_args()
    certificates = asked.certificates.resolve()
    with cluster_with(certificates) as cluster:
        if asked.only_print:
            print(cluster.job_script())
            return 0
        cluster.scale(asked.most)
        words = ("--cluster", cluster.scheduler_address, "--certificates", str(certificates))
        return subprocess.call(python_command([*THIS_PROGRAM, "batch", str(asked.missions), *words]))


if __name__ == "__main__":
    sys.exit(main())

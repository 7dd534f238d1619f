"""The registration worker: claims register jobs, estimates Sim(3) in a child process (DESIGN 3.5 and 4)."""

from __future__ import annotations

from vggt_motion.bus import codec
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.worker import BlobCache, Computation, work
from vggt_motion.config import Config
from vggt_motion.records import JobKind, Lease, RegisterTask, Stream
from vggt_motion.registration.task import load_kernels, register_submaps


def main(config: Config) -> int:
    """Run the worker until it is told to stop; returns the exit code of the process."""
    return run_service("registration", config, _serve)


def _serve(context: ServiceContext) -> None:
    cache = BlobCache(context.ledger)

    def prepare(lease: Lease) -> Computation:
        task = codec.decode(RegisterTask, lease.job.payload)
        refs = [frame.depth for shared in task.shared for frame in (shared.in_i, shared.in_j)]
        arguments = (task, cache.fetch(refs), context.config.registration)
        return Computation(register_submaps, arguments, detail=f"submaps {task.spec.i} and {task.spec.j}")

    work(
        context,
        kinds=(JobKind.REGISTER,),
        models=(),
        stream=Stream.CONSTRAINT,
        prepare=prepare,
        deadline_s=context.config.registration.job_deadline_s,
        warm_up=Computation(load_kernels, (context.config.registration,), detail="loading the kernels"),
    )

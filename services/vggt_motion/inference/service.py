"""The inference worker: claims predict jobs, predicts in a child process, returns geometry (DESIGN 3.4 and 4)."""

from __future__ import annotations

from vggt_motion.bus import codec
from vggt_motion.bus.service import ServiceContext, run_service
from vggt_motion.bus.worker import BlobCache, Computation, work
from vggt_motion.config import Config
from vggt_motion.inference.task import load_predictor, predict_submap, predict_submaps
from vggt_motion.records import JobKind, Lease, PredictTask, Stream


def main(config: Config) -> int:
    """Run the worker until it is told to stop; returns the exit code of the process."""
    return run_service("inference", config, _serve)


def _serve(context: ServiceContext) -> None:
    inference = context.config.inference
    cache = BlobCache(context.ledger)

    def prepare(lease: Lease) -> Computation:
        task = codec.decode(PredictTask, lease.job.payload)
        mask = task.spec.ego_mask
        refs = [keyframe.image for keyframe in task.keyframes] + ([mask] if mask is not None else [])
        blobs = cache.fetch(refs)
        images = blobs[: len(task.keyframes)]
        arguments = (task, images, blobs[-1] if mask is not None else None, inference)
        return Computation(
            predict_submap,
            arguments,
            detail=f"submap {task.spec.submap_index} r{task.spec.revision}",
            of_several=predict_submaps,
        )

    work(
        context,
        kinds=(JobKind.PREDICT,),
        models=(inference.predictor,),
        stream=Stream.SUBMAP,
        prepare=prepare,
        deadline_s=inference.job_deadline_s,
        warm_up=Computation(load_predictor, (inference,), detail=f"loading predictor {inference.predictor}"),
        warm_up_deadline_s=inference.load_deadline_s,
    )

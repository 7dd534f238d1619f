"""The configuration of a run: one tree of pydantic models, units in the names, dumped beside every result.

Values come from the defaults here, then a YAML file (``--config``), then environment variables
(``VGGT_MOTION_BUS__ENDPOINT=...``), then ``--set section.field=value``; later ones win. Unknown names are errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_settings import (
    BaseSettings,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from vggt_motion.errors import ConfigurationError


class Section(BaseModel):
    """Base of all sections: frozen, unknown names refused, defaults checked."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


class BusConfig(Section):
    """How a process joins the bus."""

    endpoint: str = Field("tcp/127.0.0.1:7447", description="Zenoh endpoint of the router")
    session: str = Field(
        "default", pattern=r"^[A-Za-z0-9_.-]{1,64}$", description="name of the session, part of every key"
    )
    lease_s: float = Field(4.0, gt=0.1, description="link lease: a frozen peer is gone after this")
    connect_timeout_s: float = Field(10.0, gt=0, description="how long to try to reach the router before giving up")
    request_timeout_s: float = Field(10.0, gt=0, description="how long one acknowledged request may take")
    shared_memory: bool = Field(False, description="explicit single-host switch; has hazards, see the documentation")
    local_parcels: bool = Field(
        True, description="long payloads between processes of one machine go by files in memory instead of the router"
    )
    zenoh_config: Path | None = Field(None, description="JSON5 file merged under ours (TLS, authentication)")


class LedgerConfig(Section):
    """The durable log and the job queue."""

    reserve_bytes: int = Field(256 * 2**20, ge=0, description="below this much free disk new keyframes are refused")
    lease_duration_s: float = Field(
        10.0, gt=0, description="a job whose worker sent no heartbeat for so long is open again"
    )
    max_failures: int = Field(3, ge=1, description="failures that workers report until a job is dead")
    max_lost_leases: int = Field(10, ge=1, description="lost leases until a job is dead")
    retry_backoff_s: float = Field(0.5, ge=0, description="a failed job waits this long, doubled each time")
    recent_bytes: int = Field(32 * 2**20, ge=0, description="so much of the last payloads is answered from memory")


# What VGGT-Long calls chunk 60 / overlap 30 is a base of 30 keyframes here, together with an overlap of 30.
_FRONTEND_PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {"turning_score": "lateral", "turning_flow_px": 5.0, "parallax_px": 15.0},
    "vggt_long": {
        "selection": "dense",
        "static_pruning": False,
        "partition": "temporal",
        "max_keyframes": 30,
        "overlap_keyframes": 30,
    },
    "vggt_long_75": {
        "selection": "dense",
        "static_pruning": False,
        "partition": "temporal",
        "max_keyframes": 45,
        "overlap_keyframes": 30,
        "turn_max_keyframes": 45,
    },
}


class FrontendConfig(Section):
    """Motion state, keyframes and partition (paper section 3.1, DESIGN 3.1 and 3.2)."""

    preset: Literal["default", "paper", "vggt_long", "vggt_long_75"] = Field(
        "default", description="values for all that is not set by itself: the paper's as printed, or VGGT-Long's chunks"
    )
    flow_width_px: int = Field(
        320,
        ge=64,
        le=2048,
        description="working width; the pixel thresholds below are taken at 320 px and scale with it",
    )
    static_flow_px: float = Field(0.7, gt=0, description="tau_flow: below it a pixel is quasi-static")
    static_ratio: float = Field(
        0.9, gt=0, le=1, description="tau_static: share of quasi-static pixels of a standing camera"
    )
    turning_score: Literal["yaw", "lateral"] = Field("yaw", description="signed common shift, or the paper's mean |fx|")
    turning_flow_px: float = Field(1.6, gt=0, description="tau_turn for the chosen score, per 0.1 s")
    smoothing_sigma_frames: float = Field(2.0, ge=0, description="Gaussian smoothing of the scores")
    smoothing_lookahead_frames: int = Field(4, ge=0, description="frames after the present one that smoothing may see")
    selection: Literal["dense", "uniform", "covisibility", "parallax"] = "parallax"
    static_pruning: bool = True
    disk_policy: Literal["wait", "thin"] = Field(
        "wait",
        description="files, while the ledger has no space: read no further, or let frames go by",
    )
    parallax_px: float = Field(
        6.3, gt=0, description="tau_palx: shift since the last keyframe without its common part (frontend/keyframes.py)"
    )
    uniform_stride: int = Field(3, ge=1, description="for selection = uniform")
    covisibility_ratio: float = Field(
        0.7, gt=0, lt=1, description="for selection = covisibility: below it a new keyframe"
    )
    partition: Literal["temporal", "parallax", "topology"] = "topology"
    max_keyframes: int = Field(12, ge=2, description="N_max: base keyframes of a submap without a turn")
    overlap_keyframes: int = Field(5, ge=1, description="N_ovlp")
    turn_max_keyframes: int = Field(36, ge=2, description="base keyframes at which even a turn is cut")
    partition_parallax_px: float = Field(
        180.0, gt=0, description="for partition = parallax: cumulative parallax of a submap"
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in_preset(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        # an unknown name is refused by the field itself, with the names that there are
        return {**_FRONTEND_PRESETS.get(str(data.get("preset", "default")), {}), **data}

    @model_validator(mode="after")
    def _orders(self) -> FrontendConfig:
        if self.overlap_keyframes > self.max_keyframes:
            raise ValueError("overlap_keyframes must not be larger than max_keyframes")
        if self.turn_max_keyframes < self.max_keyframes:
            raise ValueError("turn_max_keyframes must not be smaller than max_keyframes")
        return self


class SpoolConfig(Section):
    """Where the frontend of a live camera keeps what the ledger has not acknowledged yet."""

    directory: Path | None = Field(None, description="folder; None = .vggt-motion/spool in the user's home")
    max_bytes: int = Field(
        4 * 2**30,
        ge=0,
        description="when it, or its disk up to ledger.reserve_bytes, is full, frames go by",
    )


class SfmConfig(Section):
    """The default predictor."""

    width_px: int = Field(620, ge=160, le=4096, description="images wider than this are reduced to it for tracking")
    depth_width_px: int = Field(310, ge=80, le=2048, description="width of the dense depth maps")
    seed: int = Field(0, ge=0)


class VggtConfig(Section):
    """The predictor ``vggt``: any checkpoint of that architecture."""

    model: str = Field(
        "facebook/VGGT-1B", min_length=1, description="a .pt or .safetensors file, or a Hugging Face name OWNER/NAME"
    )
    allow_download: bool = Field(True, description="fetch a Hugging Face name that is not in the cache")
    device: str = Field("auto", pattern=r"^(auto|cpu|mps|cuda(:\d{1,2})?)$")
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = Field(
        "auto", description="of the transformer; heads run in float32"
    )
    cpu_threads: int | None = Field(None, ge=1, description="of torch; None = its own choice, all cores")
    width_px: int = Field(518, ge=70, le=2072, multiple_of=14, description="width of the network's images")
    frame_chunk: int | None = Field(
        None, ge=1, description="frames that the heads take at a time; None = by free memory, at most"
    )
    max_batch_submaps: int = Field(8, ge=1, description="submaps of one shape that are predicted together at most")
    memory_reserve_bytes: int = Field(512 * 2**20, ge=0, description="free memory that a prediction must leave")
    dense_levels: tuple[int, int, int, int] | None = Field(
        None, description="levels that the dense heads read, for checkpoints that are neither 4 nor 24 levels deep"
    )


class ForeignConfig(Section):
    """A predictor that runs another project's package, in that package's own Python environment."""

    model: str = Field(min_length=1, description="the package's name for its weights: a Hugging Face name or a folder")
    python: Path | None = Field(
        None, description="interpreter of the environment that has the package; None = the one that runs us"
    )
    device: str = Field("auto", pattern=r"^(auto|cpu|mps|cuda(:\d{1,2})?)$")


class RecordedConfig(Section):
    """The predictor ``recorded``: geometry of an earlier run, for tests and scale runs."""

    ledger: Path | None = Field(None, description="folder of that run's ledger")
    seconds_per_submap: float = Field(0.0, ge=0, description="a prediction takes at least so long")


class SkyConfig(Section):
    """Sky that is kept out of depth and confidence."""

    model: Path | None = Field(None, description="skyseg.onnx, brought by the user; None = sky is not looked for")
    threshold: float = Field(
        32 / 255, gt=0, lt=1, description="sky where the segmenter's value, stretched to [0, 1] per image, reaches this"
    )
    min_peak: float = Field(
        0.5,
        ge=0,
        le=1,
        description="a frame whose largest raw value stays below this has no sky: guard for the stretch",
    )


class IntrinsicsConfig(Section):
    """A camera that the user knows: pixels of the images as recorded, the centre of the top left one is (0, 0)."""

    fx: float = Field(gt=0, description="focal length, px")
    fy: float | None = Field(None, gt=0, description="None = square pixels")
    cx: float = Field(ge=0, description="principal point, px from the left")
    cy: float = Field(ge=0, description="principal point, px from the top")
    k1: float = Field(0.0, ge=-1, le=1, description="radial coefficient, as OpenCV defines it")


class InferenceConfig(Section):
    """The predictor and its worker."""

    predictor: str = Field("sfm", description="auto = vggt where torch, an accelerator and weights are there, else sfm")
    predictor_reason: str = Field("", description="why auto became what it is; written by run")
    focal_over_width: float | None = Field(
        None, gt=0.1, lt=20, description="known focal length / image width; None = self-calibrate"
    )
    radial_k1: float | None = Field(None, ge=-1, le=1, description="known radial coefficient")
    intrinsics: IntrinsicsConfig | None = Field(None, description="known camera; replaces the two above")
    job_deadline_s: float = Field(
        300.0, gt=0, description="a prediction that takes longer is ended and reported as failed"
    )
    load_deadline_s: float = Field(
        3600.0, gt=0, description="what loading the predictor may take, a download of its weights included"
    )
    sfm: SfmConfig = SfmConfig()
    vggt: VggtConfig = VggtConfig()
    pi3: ForeignConfig = ForeignConfig(model="yyfz233/Pi3")
    pi3x: ForeignConfig = ForeignConfig(model="yyfz233/Pi3X")
    depth_anything_3: ForeignConfig = ForeignConfig(model="depth-anything/DA3NESTED-GIANT-LARGE-1.1")
    map_anything: ForeignConfig = ForeignConfig(model="facebook/map-anything-apache")
    recorded: RecordedConfig = RecordedConfig()
    sky: SkyConfig = SkyConfig()


class RegistrationConfig(Section):
    """Sim(3) constraints (paper section 3.2, DESIGN 3.5)."""

    anchor: Literal["window1", "window3", "window5", "full"] = "window1"
    confidence_mode: Literal["quantile", "mean_coef", "median_coef", "absolute"] = "quantile"
    confidence_value: float = Field(0.5, ge=0, description="tau_conf in the chosen mode")
    residual: Literal["depth_relative", "absolute"] = Field(
        "depth_relative", description="absolute is the peers' baseline"
    )
    huber_relative: float = Field(0.02, gt=0, description="Huber width on depth-relative residuals")
    huber_absolute: float = Field(0.1, gt=0, description="Huber width, submap units, for residual = absolute")
    scale_rule: Literal["least_squares", "symmetric"] = "symmetric"
    inlier_relative: float = Field(0.05, gt=0, description="inlier radius on depth-relative residuals")
    max_iterations: int = Field(20, ge=1)
    min_inlier_ratio: float = Field(0.5, ge=0, le=1, description="tau_in: below it the edge is dropped")
    min_points: int = Field(500, ge=3)
    job_deadline_s: float = Field(60.0, gt=0)


class LoopsConfig(Section):
    """Loop composition (DESIGN 3.3)."""

    enabled: bool = False


class BackendConfig(Section):
    """Pose graph and map."""

    huber_sigma: float = Field(1.345, gt=0, description="Huber width in standard deviations of one dimension")
    loop_loss: Literal["huber", "cauchy", "cauchy_gate"] = Field(
        "cauchy_gate", description="how loops are kept from lying; cauchy_gate switches off those that disagree"
    )
    loop_cauchy_sigma: float = Field(
        2.5, gt=0, description="Cauchy width in standard deviations of the residual's norm"
    )
    loop_gate_sigma: float = Field(5.5, gt=0, description="loops with a larger residual are switched off")
    solve_deadline_s: float = Field(120.0, gt=0)
    map_confidence: float = Field(0.5, ge=0, le=1, description="points below this confidence stay out of the map")
    map_voxel_over_step: float = Field(
        0.05, ge=0, description="voxel edge as a share of the median keyframe distance; 0 = none"
    )
    map_max_points: int = Field(2_000_000, ge=1000)
    known_distance_m: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="known travelled distance: sets the scale"
    )


class GatewayConfig(Section):
    """The HTTP gateway."""

    host: str = "127.0.0.1"
    port: int = Field(8000, ge=0, le=65535, description="0 = any free port")
    token: str | None = Field(None, min_length=16, description="bearer token; needed for any address but loopback")


class RecorderConfig(Section):
    """The MCAP recorder."""

    enabled: bool = True
    flush_interval_s: float = Field(
        1.0, gt=0, description="at most this much of the recording is lost with the process"
    )
    chunk_bytes: int = Field(2**20, ge=1024)


class RunConfig(Section):
    """The local processes of ``vggt-motion run``."""

    inference_workers: int = Field(1, ge=1, le=64)
    registration_workers: int = Field(1, ge=1, le=64)
    camera: str = Field("front", pattern=r"^[A-Za-z0-9_.-]{1,64}$")
    nominal_rate_hz: float = Field(
        10.0, gt=0, lt=1e5, description="frame rate of a folder or stream that says nothing about time"
    )


class Config(BaseSettings):
    """Everything that a run can be told."""

    model_config = SettingsConfigDict(
        frozen=True,
        extra="forbid",
        validate_default=True,
        env_prefix="VGGT_MOTION_",
        env_nested_delimiter="__",
    )

    bus: BusConfig = BusConfig()
    ledger: LedgerConfig = LedgerConfig()
    spool: SpoolConfig = SpoolConfig()
    frontend: FrontendConfig = FrontendConfig()
    inference: InferenceConfig = InferenceConfig()
    registration: RegistrationConfig = RegistrationConfig()
    loops: LoopsConfig = LoopsConfig()
    backend: BackendConfig = BackendConfig()
    gateway: GatewayConfig = GatewayConfig()
    recorder: RecorderConfig = RecorderConfig()
    run: RunConfig = RunConfig()

    def to_yaml(self) -> str:
        """The effective configuration as YAML, read back by :func:`load_config` as an equal one; without the token."""
        data = self.model_dump(mode="json", exclude={"gateway": {"token"}})
        text: str = yaml.safe_dump(data, sort_keys=False)
        return text


def load_config(file: Path | None = None, assignments: Sequence[str] = ()) -> Config:
    """Build the effective configuration.

    Args:
        file: YAML file with any part of the tree.
        assignments: ``section.field=value`` strings; the value is read as YAML.

    Raises:
        ConfigurationError: one line that names the offending place.
    """
    from_file = _read_file(file) if file is not None else {}
    from_command: dict[str, Any] = {}
    for assignment in assignments:
        path, separator, text = assignment.partition("=")
        if not separator or not path:
            raise ConfigurationError(f"'{assignment}' is not of the form section.field=value")
        _assign(from_command, path.split("."), _scalar(text), assignment)

    class _Layered(Config):
        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,
            file_secret_settings: PydanticBaseSettingsSource,
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return init_settings, env_settings, InitSettingsSource(settings_cls, from_file)

    try:
        layered = _Layered(**from_command)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "configuration"
        raise ConfigurationError(f"{place}: {first['msg']}") from error
    except SettingsError as error:
        raise ConfigurationError(f"environment: {error}") from error
    # A plain Config from validated parts, so that equality and dumps do not depend on where the values came from.
    return Config.model_construct(**{name: getattr(layered, name) for name in Config.model_fields})


def _read_file(file: Path) -> dict[str, Any]:
    try:
        loaded = yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"cannot read configuration {file}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"configuration {file} is not YAML: {' '.join(str(error).split())}") from error
    if loaded is not None and not isinstance(loaded, dict):
        raise ConfigurationError(f"configuration {file} must be a mapping of sections")
    return loaded or {}


def _scalar(text: str) -> Any:
    # YAML 1.1 reads 1e-9 as a string; pydantic turns such a string into the number that the field wants.
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigurationError(f"'{text}' is not a value: {' '.join(str(error).split())}") from error


def _assign(data: dict[str, Any], path: Sequence[str], value: Any, origin: str) -> None:
    node = data
    for part in path[:-1]:
        child = node.setdefault(part, {})
        if not isinstance(child, dict):
            raise ConfigurationError(f"'{origin}': {part} is not a section")
        node = child
    node[path[-1]] = value

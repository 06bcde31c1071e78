"""The command line's grammar: every command with its options and an example."""

from __future__ import annotations

import argparse
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeAlias

ORGANS = ("colon", "small-bowel", "stomach")
FORMATS = ("asl", "endoslam", "vrcaps", "simcol3d", "scared", "tum-rgbd", "jhu-sinus", "kitti", "c3vd", "video",
           "images")
VIBRATIONS = ("none", "gaussian", "peristalsis", "collision")
DRIVING = ("natural", "operated", "brisk", "one-way", "withdrawn", "transit")
CAMERAS = ("mirocam", "fisheye-140", "fisheye-156", "pinhole-110")
PRODUCTS = ("normals", "albedo", "mask", "flow")
DATASETS = ("mm-wce",)
METHODS = ("gyro-correlation", "endosfmlearner", "af-sfmlearner", "ra-depth", "endodac")
TABLES = ("methods", "intensity", "vibration-types", "fusion", "corruptions")
BUDGETS = ("smoke", "short", "full")
FUSIONS = ("fourier", "concatenation", "summation", "gated", "aff", "iaff", "butd")


def build_parser() -> argparse.ArgumentParser:
    """The parser of `capsule-vio`; wrong usage exits with 2."""
    parser = argparse.ArgumentParser(
        prog="capsule-vio",
        description="Visual-inertial odometry for wireless capsule endoscopy. Research use only.",
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {_version()}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (_demo, _doctor, _simulate, _convert, _inspect, _train, _evaluate, _predict, _refine, _compare, _locate,
                _report, _view, _benchmark):
        add(commands)
    return parser


def _version() -> str:
    try:
        return version("capsule-vio")
    except PackageNotFoundError:
        return "(not installed)"


Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def _command(commands: Commands, name: str, help_text: str, example: str) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=help_text, description=help_text, epilog=f"example: capsule-vio {example}")


def _json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="machine-readable results on stdout, nothing else there")


def _demo(commands: Commands) -> None:
    parser = _command(commands, "demo", "simulate an examination, refine it, and compare with the truth",
                      "demo --out out/demo")
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR")
    parser.add_argument("--seed", type=int, default=1)
    _json(parser)


def _doctor(commands: Commands) -> None:
    _json(_command(commands, "doctor", "check the installation", "doctor"))


def _simulate(commands: Commands) -> None:
    parser = _command(commands, "simulate", "write a simulated recording with exact truth, or a data set of them",
                      "simulate --organ colon --vibration collision --level 3 --duration 60 --seed 1 --out REC")
    parser.add_argument("--organ", choices=ORGANS, default="small-bowel")
    parser.add_argument("--vibration", choices=VIBRATIONS, default="none")
    parser.add_argument("--level", type=int, default=0, help="vibration level, 0 to 5")
    parser.add_argument("--duration", type=float, default=60.0, metavar="S", help="seconds, of each recording")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--driving", choices=DRIVING, default="natural",
                        help="transit: as slow as in life; natural: ten times that; operated, brisk: driven through; "
                             "one-way: never back; withdrawn: half the time there, then back")
    parser.add_argument("--start", type=float, metavar="SHARE", help="place in the organ to start at, 0 to 1")
    parser.add_argument("--camera", choices=CAMERAS, default="mirocam")
    parser.add_argument("--size", type=int, default=320, metavar="PIXELS", help="width and height of the images")
    parser.add_argument("--no-images", action="store_true", help="times, IMU and truth only")
    parser.add_argument("--products", nargs="+", choices=PRODUCTS, default=[], metavar="PRODUCT",
                        help=f"beside colour and depth, of {', '.join(PRODUCTS)}")
    parser.add_argument("--motions", type=Path, metavar="FILE", help="also write motions as a network would report")
    parser.add_argument("--dataset", choices=DATASETS, help="write the paper's set-up: two data sets and the two "
                                                            "kinds of vibration; goes on where it was stopped")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes that render a data set")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")


def _convert(commands: Commands) -> None:
    parser = _command(commands, "convert", "write a recording of another format as an ASL folder (docs/formats.md)",
                      "convert Frames_S1 --to asl REC --rate-hz 30 --calibration camchain.yaml")
    parser.add_argument("source", type=Path, metavar="SRC", help="folder or film; it is only read")
    parser.add_argument("--to", choices=("asl", "kalibr"), required=True,
                        help="the whole recording, or only its calibration in Kalibr's files")
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--format", choices=FORMATS, metavar="NAME",
                        help=f"default: recognised by what lies in SRC; one of {', '.join(FORMATS)}")
    known = parser.add_argument_group("what the files do not say and you know")
    known.add_argument("--calibration", type=Path, metavar="YAML", help="Kalibr camchain.yaml or ASL cam0/sensor.yaml")
    known.add_argument("--imu-calibration", type=Path, metavar="YAML", help="Kalibr imu.yaml or ASL imu0/sensor.yaml")
    known.add_argument("--rate-hz", type=float, metavar="HZ", help="constant frame rate of data without times")
    known.add_argument("--unit-m", type=float, metavar="M", help="metres per unit of rendered or reconstructed data")
    known.add_argument("--depth-planes", type=float, nargs=2, metavar=("NEAR", "FAR"),
                       help="clip planes of the renderer, in that unit")
    known.add_argument("--presentation-times", action="store_true", default=None,
                       help="the film's presentation times ARE the capture times")
    _json(parser)


def _inspect(commands: Commands) -> None:
    parser = _command(commands, "inspect", "say what a recording holds and whether it can be used",
                      "inspect REC --html inspection.html")
    parser.add_argument("recording", type=Path, metavar="REC")
    parser.add_argument("--html", type=Path, metavar="FILE", help="also look at the images, whether camera and gyro "
                        "agree, and write a page with pictures of rates, holes, gravity and vibration")
    _json(parser)


def _train(commands: Commands) -> None:
    parser = _command(commands, "train", "train a network on recordings, without truth; goes on where it was stopped",
                      "train REC1 REC2 --calibrate REC3 --steps 4000 --out RUN")
    parser.add_argument("recordings", type=Path, nargs="+", metavar="REC")
    parser.add_argument("--method", choices=METHODS, default="gyro-correlation")
    parser.add_argument("--vision-only", action="store_true", help="without the vibration branch")
    parser.add_argument("--fusion", choices=FUSIONS, help="how vibration enters; default: fourier")
    parser.add_argument("--width", type=float, default=1.0, help="factor on the networks' channels")
    parser.add_argument("--image-size", type=int, nargs=2, metavar=("H", "W"), help="default: the method's")
    parser.add_argument("--loss", choices=("native", "paper"), default="native", help="the method's or the paper's")
    parser.add_argument("--steps", type=int, metavar="N")
    parser.add_argument("--batch-size", type=int, metavar="N", help="triplets per process")
    parser.add_argument("--seed", type=int, metavar="N")
    parser.add_argument("--workers", type=int, metavar="N", help="processes that load data")
    parser.add_argument("--patience", type=int, metavar="N", help="stop after N validations without a better loss")
    parser.add_argument("--device", choices=("cpu", "cuda"), help="default: cuda where there is one")
    parser.add_argument("--config", type=Path, metavar="c.yaml", help="any decision of `learned.train_config`")
    parser.add_argument("--start-from", type=Path, metavar="W", help="weights of the same method to begin with; "
                        "default: drawn from the seed")
    parser.add_argument("--refined", type=Path, nargs="+", metavar="RUN",
                        help="what `refine` made of the recordings, in their order: where the accelerometer measured "
                             "scale, lengths of steps teach the network how deep things are")
    parser.add_argument("--calibrate", type=Path, nargs="+", default=[], metavar="REC",
                        help="recordings with truth to calibrate covariances and scale on; default: the validation "
                             "split of those trained on, where they have truth")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN")


def _evaluate(commands: Commands) -> None:
    parser = _command(commands, "evaluate", "judge weights on recordings with truth, beside guesses without a network",
                      "evaluate REC1 REC2 --weights RUN/weights.safetensors")
    parser.add_argument("recordings", type=Path, nargs="+", metavar="REC")
    parser.add_argument("--weights", type=Path, metavar="W", help="default: those that come with the library")
    _json(parser)


def _predict(commands: Commands) -> None:
    parser = _command(commands, "predict", "measure relative motions on a recording's images",
                      "predict REC --method classical --out motions.npz")
    parser.add_argument("recording", type=Path, metavar="REC")
    parser.add_argument("--method", choices=("learned", "depth-aligned", "classical"), default="learned",
                        help="a trained network; KLT tracks laid over each other by its depth; or KLT tracks with "
                             "essential matrix and PnP")
    parser.add_argument("--weights", type=Path, metavar="W", help="default: those that come with the library")
    parser.add_argument("--rotation", choices=("network", "gyro"), default="network",
                        help="gyro: correct the rotation by the gyro; for use without `refine`, which does so itself")
    parser.add_argument("--depth", type=Path, metavar="DIR", help="also write the predicted depth maps and their sd")
    parser.add_argument("--loops", type=Path, metavar="loops.npz",
                        help="also look for places that are seen again, for `refine --loops-from`")
    parser.add_argument("--out", type=Path, required=True, metavar="motions.npz")


def _refine(commands: Commands) -> None:
    parser = _command(commands, "refine", "fuse motions and IMU into one trajectory with covariance",
                      "refine REC --motions motions.npz --out RUN")
    parser.add_argument("recording", type=Path, metavar="REC")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--motions", type=Path, nargs="+", metavar="motions.npz",
                        help="motions from any source; of several, the first one's unit is kept")
    source.add_argument("--weights", type=Path, metavar="W", help="predict the motions with these weights")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--estimator", choices=("auto", "graph", "ekf"), help="default: the configuration's, auto")
    how.add_argument("--online", action="store_true", help="frame by frame, as for a live capsule")
    parser.add_argument("--lag", type=float, default=30.0, metavar="S",
                        help="how long a frame stays open to correction online (default: 30 s)")
    parser.add_argument("--config", type=Path, metavar="c.yaml")
    again = parser.add_mutually_exclusive_group()
    again.add_argument("--loops", action="store_true",
                       help="look for places that are seen again, in the images, and close the loops")
    again.add_argument("--loops-from", type=Path, metavar="loops.npz", help="close loops that predict --loops found")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN")
    _json(parser)


def _compare(commands: Commands) -> None:
    parser = _command(commands, "compare", "runs and trajectories side by side under every alignment",
                      "compare RUN other.tum --truth truth.tum")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folder or TUM file")
    parser.add_argument("--truth", type=Path, metavar="traj.tum", help="default: the truth a run folder holds")
    parser.add_argument("--out", type=Path, metavar="DIR",
                        help="also write comparison.json, table.txt, and the compared frames as TUM files for evo")
    _json(parser)


def _locate(commands: Commands) -> None:
    parser = _command(commands, "locate", "place lesions along the gut: how far, from which landmark, how sure",
                      "locate RUN --lesions lesions.csv --depth DEPTH")
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder that refine wrote")
    parser.add_argument("--lesions", type=Path, required=True, metavar="L.csv",
                        help="columns label and frame or timestamp_s, optionally u, v, kind (finding, landmark), id; "
                             "or Kvasir-Capsule's metadata.csv")
    parser.add_argument("--depth", type=Path, metavar="DIR", help="depth maps that predict --depth wrote")
    parser.add_argument("--recording", type=Path, metavar="REC", help="the recording: its own depth maps")
    parser.add_argument("--between", nargs=2, metavar="LABEL", help="landmarks that percentages refer to (default: "
                        "pylorus and ileocecal valve; without either, the first and the last landmark)")
    parser.add_argument("--depth-sd", type=float, metavar="SHARE",
                        help="standard deviation of a depth as a share of it (default: the sd maps beside predicted "
                        "depth, 0.1 where there are none)")
    parser.add_argument("--video", metavar="ID", help="which video_id of a Kvasir-Capsule file")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where lesions.csv and lesions.json go (default: RUN)")
    _json(parser)


def _report(commands: Commands) -> None:
    parser = _command(commands, "report", "write a run's report.html again, with the lesions that locate placed",
                      "report RUN --recording REC")
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder that refine wrote")
    parser.add_argument("--recording", type=Path, metavar="REC",
                        help="the recording that was refined: pictures of the lesions")


def _view(commands: Commands) -> None:
    parser = _command(commands, "view", "write a run for the rerun viewer: poses, frames, depth and lesions over time",
                      "view RUN --recording REC --out run.rrd")
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder that refine wrote")
    parser.add_argument("--recording", type=Path, metavar="REC", help="the recording that was refined: its frames")
    parser.add_argument("--depth", type=Path, metavar="DIR", help="depth maps that predict --depth wrote")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.rrd")


def _benchmark(commands: Commands) -> None:
    parser = _command(commands, "benchmark", "measure one of the paper's tables; goes on where it was stopped "
                      "(docs/benchmarks.md)", "benchmark fusion --data DATA --budget smoke --out OUT")
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--data", type=Path, required=True, metavar="DATA",
                        help="what `simulate --dataset mm-wce --out DATA` wrote")
    parser.add_argument("--budget", choices=BUDGETS, required=True,
                        help="smoke: minutes, shows that it works; short: hours; full: the paper's, for GPUs")
    parser.add_argument("--seeds", type=int, metavar="N", help="trainings per variant (default: the budget's)")
    parser.add_argument("--method", choices=METHODS, default="af-sfmlearner",
                        help="of all tables but `methods` (default: the paper's, af-sfmlearner)")
    parser.add_argument("--device", choices=("cpu", "cuda"), help="default: cuda where there is one")
    parser.add_argument("--out", type=Path, required=True, metavar="OUT")
    _json(parser)

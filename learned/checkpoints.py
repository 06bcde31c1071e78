"""The whole state of a training run in one file, so that a resumed run does not differ by a bit.

Read with torch's `weights_only`: tensors, numbers and strings, never code.
"""

from __future__ import annotations

import json
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from learned.errors import CheckpointError
from learned.train_config import TrainConfig, different_decisions, train_config_from_dict, train_config_to_dict
from vio.atomic import atomic_write

SCHEMA = 1
KEYS = ("step", "model", "average", "average_updates", "optimiser", "rng", "world", "recordings", "early_stop",
        "skipped", "summed")


def save_checkpoint(path: str | Path, config: TrainConfig, state: Mapping[str, Any]) -> None:
    """Write the state atomically; `state` holds the `KEYS`.

    Raises:
        OutputError: the file cannot be written.
    """
    content = {"schema": SCHEMA, "config": json.dumps(train_config_to_dict(config)), **state}
    with atomic_write(path) as file:
        torch.save(content, file)


def load_checkpoint(path: str | Path, config: TrainConfig, world: int, recordings: list[str]) -> dict[str, Any]:
    """The state that `save_checkpoint` wrote, after a look at whether this run may go on with it.

    Args:
        path: the file.
        config: of the run that goes on; bookkeeping may differ from the file's.
        world: number of processes, which decides who sees which item.
        recordings: digest of every recording trained on.

    Raises:
        CheckpointError: the file cannot be read, or belongs to another run; says in what.
    """
    name = Path(path).name
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise CheckpointError(f"checkpoint {name}: {error.strerror or 'cannot be read'}; start a new run") from None
    except (RuntimeError, ValueError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile):
        raise CheckpointError(f"checkpoint {name}: damaged, or none; start a new run in another folder") from None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA or any(key not in content for key in KEYS):
        raise CheckpointError(f"checkpoint {name}: not written by this version of training; start a new run")
    different = different_decisions(train_config_from_dict(json.loads(content["config"])), config)
    if different:
        raise CheckpointError(f"checkpoint {name}: its run has another {', '.join(different)}; give the same "
                              "decisions, or start a new run in another folder")
    if content["world"] != world:
        raise CheckpointError(f"checkpoint {name}: written by {content['world']} process(es), this run has {world}; "
                              "use as many, for the order of the data depends on it")
    if content["recordings"] != recordings:
        raise CheckpointError(f"checkpoint {name}: its run saw other recordings; give the same, in the same order")
    return content

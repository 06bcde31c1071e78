"""What is concluded: learned or classical motions and inertial data become one trajectory with uncertainty.

    import fusion
    refined = fusion.refine(recording, motions)
"""

from fusion.compare import Comparison, compare
from fusion.compare_files import compare_paths, write_comparison
from fusion.compare_text import format_table
from fusion.config import RefineConfig, config_from_dict, load_config
from fusion.lesions import Lesion, LesionTable, Sighting, locate, read_lesions, read_sightings, write_lesions
from fusion.online import OnlineEstimator, OnlineMotion
from fusion.online_run import online_refine
from fusion.refine import refine
from fusion.result import ImuConclusion, Refinement, ScaleConclusion
from fusion.run_folder import Provenance, Run, read_run, write_run
from fusion.run_states import read_refinement
from fusion.summary import summarize

__all__ = [
    "Comparison", "ImuConclusion", "Lesion", "LesionTable", "OnlineEstimator", "OnlineMotion", "Provenance",
    "RefineConfig", "Refinement", "Run",
    "ScaleConclusion", "Sighting", "compare", "compare_paths", "config_from_dict", "format_table", "load_config",
    "locate", "online_refine", "read_lesions", "read_refinement", "read_run", "read_sightings", "refine", "summarize",
    "write_comparison", "write_lesions", "write_run",
]

"""What is concluded: learned or classical motions and inertial data become one trajectory with uncertainty.

    import fusion
    refined = fusion.refine(recording, motions)
"""

from fusion.compare import Comparison, compare, compare_paths, format_table
from fusion.config import RefineConfig, config_from_dict, load_config
from fusion.refine import refine
from fusion.result import ImuConclusion, Refinement, ScaleConclusion
from fusion.run_folder import Provenance, Run, read_run, write_run
from fusion.summary import summarize

__all__ = [
    "Comparison", "ImuConclusion", "Provenance", "RefineConfig", "Refinement", "Run", "ScaleConclusion", "compare",
    "compare_paths", "config_from_dict", "format_table", "load_config", "read_run", "refine", "summarize", "write_run",
]

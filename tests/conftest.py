from pathlib import Path

import pytest
from hypothesis import settings

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

settings.register_profile("capsule-vio", deadline=None)  # how long an example takes says nothing about it
settings.load_profile("capsule-vio")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the sample data in ../shared/data")
    return SHARED_DATA

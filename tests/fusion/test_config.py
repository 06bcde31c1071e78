"""Configuration: what is written is what is used, and what is not understood is refused."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fusion import RefineConfig, config_from_dict, load_config
from fusion.config import CHOICES
from vio.errors import ConfigError


def leaves(values, prefix=()):
    for key, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, (*prefix, key))
        else:
            yield (*prefix, key), value


LEAVES = list(leaves(RefineConfig().to_dict()))
NUMBERS = [path for path, value in LEAVES if not isinstance(value, str)]


def nested(path, value):
    for key in reversed(path):
        value = {key: value}
    return value


def at(config, path):
    for key in path:
        config = getattr(config, key)
    return config


def test_nothing_given_is_the_default():
    assert config_from_dict({}) == RefineConfig()
    assert config_from_dict(RefineConfig().to_dict()) == RefineConfig()


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
def test_every_number_can_be_set_alone(path, tmp_path):
    default = at(RefineConfig(), path)
    value = default + 1
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(nested(path, value)), encoding="utf-8")
    config = load_config(tmp_path / "c.yaml")
    assert at(config, path) == value and type(at(config, path)) is type(default)
    changed = [other for other, _ in LEAVES if at(config, other) != at(RefineConfig(), other)]
    assert changed == [path]


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in CHOICES.items() for value in values])
def test_every_choice_can_be_made(name, value):
    path = name.split(".")
    assert at(config_from_dict(nested(path, value)), path) == value


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
                    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(
                        st.sampled_from(["robust", "huber", "scale", "solver", "estimator", "gate", "x"]), inner,
                        max_size=3), max_leaves=6))
def test_whatever_is_read_it_is_a_configuration_or_one_line(value):
    if not isinstance(value, dict):
        value = {"scale": value}
    try:
        config = config_from_dict(value)
    except ConfigError as error:
        assert "\n" not in str(error) and str(error).startswith("configuration: ")
    else:
        assert isinstance(config, RefineConfig)
        for path, number in leaves(config.to_dict()):
            if path in NUMBERS:
                assert 0 < number < float("inf")


@pytest.mark.parametrize(("values", "words"), [
    ({"estimatr": "ekf"}, "unknown key 'estimatr'; known are estimator, robust, scale, rest, solver, initial"),
    ({"robust": {"hubber": 1}}, "unknown key 'robust.hubber'; known are huber, gate"),
    ({3: 1}, "unknown key '3'"),
    ({"estimator": "kalman"}, "estimator is 'kalman'; choose one of auto, graph, ekf"),
    ({"estimator": True}, "estimator is True; choose one of"),
    ({"scale": {"policy": ["free"]}}, "scale.policy is ['free']; choose one of auto, free, prior, fixed"),
    ({"robust": {"huber": -1}}, "robust.huber is -1; must be a positive number"),
    ({"robust": {"huber": 0}}, "robust.huber is 0; must be a positive number"),
    ({"robust": {"gate": float("nan")}}, "robust.gate is nan; must be a positive number"),
    ({"robust": {"gate": float("inf")}}, "robust.gate is inf"),
    ({"robust": {"gate": "large"}}, "robust.gate is 'large'"),
    ({"robust": {"gate": True}}, "robust.gate is True"),
    ({"robust": {"gate": 10**400}}, "must be a positive number"),
    ({"robust": {"gate": "inf"}}, "robust.gate is 'inf'; must be a positive number"),
    ({"robust": {"gate": None}}, "robust.gate is None"),
    ({"robust": 5}, "robust must be a mapping, got 5"),
    ({"solver": {"chunk_frames": 10.5}}, "solver.chunk_frames is 10.5; must be a whole number"),
    ({"solver": {"max_iterations": 0}}, "solver.max_iterations is 0"),
])
def test_what_is_not_understood_is_refused(values, words):
    with pytest.raises(ConfigError) as caught:
        config_from_dict(values)
    message = str(caught.value)
    assert message.startswith("configuration: ") and words in message and "\n" not in message
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("number", ["1e-8", "1E-8", "1.0e-8", "0.00000001"])
def test_scientific_notation_without_a_point_is_a_number(tmp_path, number):
    """YAML 1.1 reads 1e-8 as text."""
    (tmp_path / "c.yaml").write_text(f"solver:\n  relative_tolerance: {number}\n", encoding="utf-8")
    assert load_config(tmp_path / "c.yaml").solver.relative_tolerance == 1e-8


@pytest.mark.parametrize("text", ["", "# nothing\n", "{}"])
def test_an_empty_file_is_the_default(tmp_path, text):
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    assert load_config(tmp_path / "c.yaml") == RefineConfig()


@pytest.mark.parametrize(("data", "words"), [
    (None, "c.yaml: cannot be read"), (b"\xff\xfe\x00a", "c.yaml: cannot be read"),
    (b"robust: [1", "c.yaml: not valid YAML"), (b"a: b: c", "c.yaml: not valid YAML"),
    (b"- 1\n- 2\n", "c.yaml: must hold a mapping"), (b"ekf", "c.yaml: must hold a mapping"),
    (b"robust: !!python/object:os.system {}", "c.yaml: not valid YAML"),
    (b"robust:\n  typo: 1\n", "unknown key 'robust.typo'"),
])
def test_a_file_that_is_no_configuration_is_refused(tmp_path, data, words):
    if data is not None:
        (tmp_path / "c.yaml").write_bytes(data)
    with pytest.raises(ConfigError) as caught:
        load_config(tmp_path / "c.yaml")
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert str(tmp_path) not in str(caught.value)

"""The catalog: every entry can be filled in from a scenario."""

import inspect
import typing

import pytest

from holdfast import catalog
from holdfast.shell.schema import in_words, model_of

ENTRIES = [(section, name) for section, parts in catalog.SECTIONS.items() for name in parts]


def test_names_are_used_once():
    names = [name for _, name in ENTRIES]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(("section", "name"), ENTRIES)
def test_every_key_has_a_type_that_a_message_can_name(section, name):
    build = catalog.SECTIONS[section][name]
    given = 0 if section == "plant" else 1
    parameters = list(inspect.signature(build).parameters.values())
    if given:
        assert parameters[0].name == "plant"
    hints = typing.get_type_hints(build)
    for key, field in model_of(build, given).model_fields.items():
        if key in ("x0", "P0", "constraints"):
            continue
        assert key in hints, key
        assert in_words(field.annotation), key


@pytest.mark.parametrize("name", catalog.DETECTORS)
def test_detectors_have_the_common_keys(name):
    fields = model_of(catalog.DETECTORS[name], 1).model_fields
    assert {"level", "on", "threshold"} <= fields.keys()
    assert fields["level"].default == 0.01


@pytest.mark.parametrize("name", catalog.ATTACKS)
def test_attacks_have_the_common_keys(name):
    # a switch is thrown at no sensor, actuator or channel
    where = {"to"} if name == "switch" else {"channel", "channels"}
    assert {*where, "start", "stop"} <= model_of(catalog.ATTACKS[name], 1).model_fields.keys()

"""Things by name: built in, registered, installed; a name stands for one of them."""

import subprocess
import sys
import textwrap

import pytest
from child_environment import child_environment

from tissue_sim.errors import InputError
from tissue_sim.registry import (
    Registry,
    get_modules_of_additions_by_name,
    list_registered_groups_names_objects,
    register_objects_of_other_process,
)


class Thing:
    name = "third"


def test_names_without_importing_and_things_on_use():
    table = Registry("thing", "tests.lazy", {"first": "os.path:join", "none": "no_such_module:thing"})
    assert list(table) == ["first", "none"] and "none" in table and len(table) == 2
    import os.path

    assert table["first"] is os.path.join
    with pytest.raises(ModuleNotFoundError):
        table["none"]


def test_a_taken_name_is_refused_and_the_same_thing_is_not():
    table = Registry("thing", "tests.taken", {"first": 1})
    table.register(Thing)
    table.register(Thing)
    assert table["third"] is Thing and ("tests.taken", "third", Thing) in list_registered_groups_names_objects()
    with pytest.raises(InputError, match="'first' is taken by another thing"):
        table.register(2, "first")
    with pytest.raises(InputError, match="did you mean 'third'"):
        table.find("thrid")
    with pytest.raises(InputError, match="needs a name"):
        table.register(3)
    table.unregister("third")
    assert "third" not in table and not any(group == "tests.taken" for group,
                                            *_ in list_registered_groups_names_objects())
    with pytest.raises(InputError, match="'first' cannot be removed: this process has registered no thing"):
        table.unregister("first")


def test_an_alias_finds_the_object_and_is_in_no_list():
    table = Registry("thing", "tests.alias", {"first": 1}, aliases={"one": "first"})
    assert "one" in table and table["one"] is table.find("one") is table["first"]
    assert list(table) == ["first"] and len(table) == 1 and dict(table) == {"first": 1}
    assert table.get_name_of_alias("one") == table.get_name_of_alias("first") == "first"
    with pytest.raises(InputError, match="'one' is taken by another thing"):
        table.register(2, "one")
    with pytest.raises(InputError, match="'one' cannot be removed"):
        table.unregister("one")


def test_what_another_process_has_is_taken_over_once():
    table = Registry("thing", "tests.over", {"first": 1})
    register_objects_of_other_process([("tests.over", "first", 2), ("tests.over", "second", 3),
                                       ("tests.unknown", "x", 4)])
    assert dict(table) == {"first": 1, "second": 3}


def test_installed_packages_add_theirs(tmp_path):
    """Through an entry point; a package that takes a built-in name is said so."""
    (tmp_path / "their_module.py").write_text("thing = 'theirs'\n", encoding="utf-8")
    info = tmp_path / "their_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text("[tests.things]\nsecond = their_module:thing\n", encoding="utf-8")
    script = textwrap.dedent("""
        from tissue_sim.errors import InputError
        from tissue_sim.registry import Registry
        table = Registry("thing", "tests.things", {"first": "ours"})
        assert list(table) == ["first", "second"] and table["second"] == "theirs"
        try:
            list(Registry("thing", "tests.things", {"second": "ours"}))
        except InputError as error:
            print(error)
    """)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, encoding="utf-8", check=True,
                          env=child_environment(tmp_path))
    assert "'second' of their_module:thing has the name of a built-in one" in done.stdout


def test_objects_that_tasks_do_not_use_stay_in_this_process():
    """They are neither sent to workers nor parts of the digest of a result."""
    used, own = Registry("thing", "tests.used", {}), Registry("thing", "tests.own", {}, is_used_in_tasks=False)
    for table in (used, own):
        table.register(Thing)
    try:
        groups = {group for group, _, _ in list_registered_groups_names_objects()}
        assert "tests.used" in groups and "tests.own" not in groups
        assert Thing.__module__ in get_modules_of_additions_by_name()
        used.unregister("third")
        assert Thing.__module__ not in get_modules_of_additions_by_name()
    finally:
        own.unregister("third")

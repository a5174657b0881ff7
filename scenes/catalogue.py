"""Catalogue of the scenes: the kinds of test that use a tool, which can therefore be simulated and shown."""

from collections.abc import Iterator, Mapping

from tissue_sim.experiment.kinds.kind import KINDS, TestKind


class _MappingOfTestKindsWithTool(Mapping[str, TestKind]):
    """Read-only mapping, name -> kind of test, of all `KINDS` with a tool; kinds of installed packages are included."""

    def __getitem__(self, name: str) -> TestKind:
        kind = KINDS[name]
        if kind.has_gripped_ends:
            raise KeyError(name)
        return kind

    def __iter__(self) -> Iterator[str]:
        return (name for name, kind in KINDS.items() if not kind.has_gripped_ends)

    def __len__(self) -> int:
        return sum(1 for _ in self)


#: Scenes by name.
SCENES: Mapping[str, TestKind] = _MappingOfTestKindsWithTool()

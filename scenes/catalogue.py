"""The scenes by name: the kinds of test that have a tool, so that they can be simulated and looked at."""

from collections.abc import Iterator, Mapping

from tissue_sim.experiment.kinds.kind import KINDS, TestKind


class _Scenes(Mapping[str, TestKind]):
    """Those of `KINDS` that have a tool, what packages add included."""

    def __getitem__(self, name: str) -> TestKind:
        kind = KINDS[name]
        if kind.gripped:
            raise KeyError(name)
        return kind

    def __iter__(self) -> Iterator[str]:
        return (name for name, kind in KINDS.items() if not kind.gripped)

    def __len__(self) -> int:
        return sum(1 for _ in self)


SCENES: Mapping[str, TestKind] = _Scenes()

"""The sources of the clients are part of the wheel, in the folder that `get_source_folder` returns."""

import zipfile

from hatchling.builders.wheel import WheelBuilder

from haptics.clients import get_source_folder


def test_wheel_contains_the_sources_of_the_clients(root, tmp_path):
    wheel, = WheelBuilder(str(root)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "wheel")
    installed = tmp_path / "wheel" / get_source_folder().relative_to(root)
    for folder, some in (("c", "include/tissue_sim_client.h"), ("csharp", "TissueSimClient.cs"),
                         ("packets", "packets.json")):
        here, there = ({path.relative_to(each) for path in (each / folder).rglob("*") if path.is_file()}
                       for each in (get_source_folder(), installed))
        assert here == there and any(path.as_posix() == f"{folder}/{some}" for path in there)

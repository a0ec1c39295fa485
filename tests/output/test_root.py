# SPDX-License-Identifier: LGPL-3.0-or-later
import pytest

from fenicsx_hmcontact.output.root import on_root


class SceneError(Exception):
    def __init__(self, group, reason):
        super().__init__(group, reason)


class UnsendableError(Exception):
    def __init__(self, group, reason):
        super().__init__(f"{group}: {reason}")


def fail(error):
    raise error


@pytest.mark.mpi
def test_only_rank_0_acts(comm):
    done = []
    found = on_root(comm, lambda: done.append(comm.rank) or "done")
    assert found == ("done" if comm.rank == 0 else None)
    assert done == ([0] if comm.rank == 0 else [])


@pytest.mark.mpi
def test_all_ranks_hear_of_a_failure(comm):
    with pytest.raises(FileNotFoundError, match="ground"):
        on_root(comm, lambda: fail(FileNotFoundError("ground.msh")))
    with pytest.raises(SceneError, match="ground"):
        on_root(comm, lambda: fail(SceneError("ground", "no facet")))
    with pytest.raises(UnsendableError if comm.rank == 0 else RuntimeError, match="ground"):
        on_root(comm, lambda: fail(UnsendableError("ground", "no facet")))

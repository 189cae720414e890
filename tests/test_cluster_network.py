"""A Ray that jaxbox starts listens on the loopback interface alone, by the kernel's table of sockets."""

import ipaddress
import os
import pathlib
import sys
import types

import pytest

from jaxbox.cluster import ClusterError
from jaxbox.cluster import run as cluster_run
from jaxbox.cluster.run import joined_ray

# Ray Data's settings warn of their own old names.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:ray")
LISTENS = "0A"
STARTED_BY_RAY = ("gcs_server", "raylet")


def listening():
    """Address of each listening TCP socket, by its inode."""
    found = {}
    for table in ("tcp", "tcp6"):
        for line in pathlib.Path("/proc/net", table).read_text().splitlines()[1:]:
            _, local, _, state, *rest = line.split()
            if state == LISTENS:
                # Words of four bytes, each in the machine's order.
                data = bytes.fromhex(local.split(":")[0])
                words = [
                    data[i : i + 4][:: -1 if sys.byteorder == "little" else 1] for i in range(0, len(data), 4)
                ]
                found[rest[5]] = ipaddress.ip_address(b"".join(words))
    return found


def is_loopback(address):
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback


def family_of(pid):
    """A process and all that descend from it, with their command lines."""
    children, lines = {}, {}
    for folder in pathlib.Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            lines[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:  # it has ended meanwhile
            continue
        children.setdefault(parent, []).append(int(folder.name))
    family = [pid]
    for member in family:
        family += children.get(member, [])
    return {member: lines[member] for member in family if member in lines}


def sockets_of(pids):
    for pid in pids:
        for link in pathlib.Path(f"/proc/{pid}/fd").glob("*"):
            try:
                target = os.readlink(link)
            except OSError:
                continue
            if target.startswith("socket:["):
                yield target[len("socket:[") : -1]


def test_the_table_tells_loopback_from_all_interfaces():
    assert is_loopback(ipaddress.ip_address("127.0.0.1"))
    assert is_loopback(ipaddress.ip_address("::1"))
    assert is_loopback(ipaddress.ip_address("::ffff:127.0.0.1"))
    for other in ("0.0.0.0", "::", "192.0.2.2", "::ffff:192.0.2.2"):
        assert not is_loopback(ipaddress.ip_address(other))


def test_every_socket_of_a_ray_started_here_is_on_loopback(monkeypatch):
    monkeypatch.setenv(cluster_run.CLUSTERS_VARIABLE, "1")
    before = set(listening())
    with joined_ray(None, 1, 1) as ray:
        assert ray.get(ray.remote(lambda: 6 * 7).remote()) == 42
        family, table = family_of(os.getpid()), listening()
        ours = [table[inode] for inode in sockets_of(family) if inode in table and inode not in before]
        for name in STARTED_BY_RAY:
            assert any(name in line for line in family.values()), f"no {name} among the processes"
    assert len(ours) >= len(STARTED_BY_RAY), "each of them listens"
    assert [str(address) for address in ours if not is_loopback(address)] == []
    assert os.environ[cluster_run.CLUSTERS_VARIABLE] == "1", "the user's own is put back"


class OtherRay:
    """One that went its own way."""

    __version__ = "9.9"
    is_shut_down = False

    def __init__(self, address):
        self.util = types.SimpleNamespace(get_node_ip_address=lambda: address)

    def shutdown(self):
        self.is_shut_down = True


def test_a_ray_that_is_not_on_loopback_is_ended_and_refused():
    other = OtherRay("192.0.2.7")
    with pytest.raises(ClusterError, match=r"9\.9 listens at 192\.0\.2\.7, .*--address"):
        cluster_run._check_loopback(other)
    assert other.is_shut_down
    here = OtherRay("127.0.0.1")
    cluster_run._check_loopback(here)
    assert not here.is_shut_down

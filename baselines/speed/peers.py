"""The peers: what each simulates, how it is installed, and which run in processes of their own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from tlf_env.common.errors import suggestion

MPE2, VMAS = "mpe2/simple_spread_v3", "vmas/diff_drive"
SPREAD, JAXNAV = "jaxmarl/MPE_simple_spread_v3", "jaxmarl/jaxnav"
KHEPERAX, DRONES = "kheperax/standard", "gym-pybullet-drones/MultiHoverAviary"
ALONE, VECTOR = "tlf_env/infinity-v0", "tlf_env.FormationVectorEnv"
PEER_ROBOTS = 3  # of peers with many formations


@dataclass(frozen=True)
class Simulated:
    """What an environment simulates, in the words of its row in docs/performance.md."""

    model: str
    step: str  # what one step advances
    substeps: str  # in a step
    sensors: str
    contacts: str
    controllers: str  # on board, beneath the action


@dataclass(frozen=True)
class Peer:
    """An environment that ours are compared with, or one of ours in a process of its own."""

    name: str
    package: str  # what its Python imports
    install: str  # words after `pip install`
    factory: str  # module:function that makes a drive, see baselines.speed.served
    simulated: Simulated
    robots: tuple[int, ...] = (PEER_ROBOTS,)
    many: bool = True  # whether one call steps many formations
    served: bool = True  # whether it is timed in a process of its own
    packages: tuple[str, ...] = ()  # whose versions are reported

    @property
    def extra(self) -> str:
        """What it is called in ``--peer-python``: its package."""
        return self.package.replace("_", "-")


POINTS = Simulated(
    model="dynamic: damped point masses that are pushed",
    step="0.1 s",
    substeps="1",
    sensors="none: true positions",
    contacts="soft repulsion",
    controllers="none",
)
PEERS: dict[str, Peer] = {
    peer.name: peer
    for peer in (
        Peer(
            name=MPE2,
            package="mpe2",
            install="'tlf-env[peers]'",
            factory="baselines.speed.mpe2:mpe2_drive",
            simulated=POINTS,
            robots=(3, 5),
            many=False,
            served=False,
            packages=("mpe2",),
        ),
        Peer(
            name=VMAS,
            package="vmas",
            install="'tlf-env[peers]'",
            factory="baselines.speed.vmas:vmas_served",
            simulated=Simulated(
                model="kinematic: unicycles that follow their command, Runge–Kutta of order 4",
                step="20 ms",
                substeps="10",
                sensors="none: true poses",
                contacts="soft repulsion",
                controllers="none",
            ),
            served=False,
            packages=("vmas", "torch"),
        ),
        Peer(
            name=SPREAD,
            package="jaxmarl",
            install="'tlf-env[peers-jax]'",
            factory="baselines.speed.jax_peers:spread_drive",
            simulated=POINTS,
            packages=("jaxmarl", "jax"),
        ),
        Peer(
            name=JAXNAV,
            package="jaxmarl",
            install="'tlf-env[peers-jax]'",
            factory="baselines.speed.jax_peers:jaxnav_drive",
            simulated=Simulated(
                model="kinematic: unicycles with limited acceleration, Euler",
                step="0.1 s",
                substeps="1",
                sensors="lidar of 16 beams (default 200), each looked up at 120 points; no noise",
                contacts="found with walls and robots; a robot that touches stays where it is",
                controllers="none",
            ),
            packages=("jaxmarl", "jax"),
        ),
        Peer(
            name=KHEPERAX,
            package="kheperax",
            # Version 0.2.0 on PyPI calls jax.tree_leaves, which jax no longer has.
            install="'git+https://github.com/adaptive-intelligent-robotics/Kheperax'",
            factory="baselines.speed.jax_peers:kheperax_drive",
            simulated=Simulated(
                model="kinematic: wheels that follow their command",
                step="1 (no unit)",
                substeps="1",
                sensors="3 lasers, 2 bumpers; no noise by default",
                contacts="a move into a wall is undone; one robot in each maze",
                controllers="none",
            ),
            robots=(1,),
            packages=("kheperax", "jax"),
        ),
        Peer(
            name=DRONES,
            package="gym_pybullet_drones",
            install="'setuptools<82' 'git+https://github.com/utiasDSL/gym-pybullet-drones'",
            factory="baselines.speed.drones:drones_drive",
            simulated=Simulated(
                model="dynamic: quadcopters as rigid bodies, in Bullet",
                step="1/48 s",
                substeps="5",
                sensors="none: true state",
                contacts="of rigid bodies",
                controllers="velocity and attitude PID, once in a step",
            ),
            robots=(3, 5),
            many=False,
            packages=("gym-pybullet-drones", "pybullet"),
        ),
    )
}
OURS: dict[str, Peer] = {
    own.name: own
    for own in (
        Peer(
            name=ALONE,
            package="tlf_env",
            install="tlf-env",
            factory="baselines.speed.own:single_drive",
            simulated=Simulated(
                model="dynamic: five bodies a robot, dry friction, wheels that slip",
                step="20 ms",
                substeps="20",
                sensors="encoders, position fixes and gyro with noise; EKF in every substep",
                contacts="of rigid bodies, pymunk",
                controllers="wheel loops in every substep, tracking law in every step",
            ),
            many=False,
        ),
        Peer(
            name=VECTOR,
            package="tlf_env",
            install="tlf-env",
            factory="baselines.speed.own:vector_drive",
            simulated=Simulated(
                model="the same",
                step="20 ms",
                substeps="20",
                sensors="the same",
                contacts="found and reported",
                controllers="the same",
            ),
        ),
    )
}
LEFT_OUT = {
    "JaxRobotarium": "robots of the Robotarium in JAX, an option of JaxMARL: not in its package on PyPI but a "
    "submodule of its repository (`git clone --recursive`), and no package of its own."
}  # what could not be installed, and why


def pythons_of(options: Iterable[str]) -> dict[str, str]:
    """The values of ``--peer-python``, each ``NAME=PYTHON``.

    Raises
    ------
    ValueError
        for another text.
    """
    found = {}
    for option in options:
        name, sign, python = option.partition("=")
        if not sign:
            raise ValueError(f"--peer-python {option!r} must be NAME=PYTHON")
        found[name] = python
    return checked_pythons(found)


def checked_pythons(given: Mapping[str, str]) -> dict[str, str]:
    """The Python of each package that is given one.

    Raises
    ------
    ValueError
        for a package that no process of its own is used for, or a Python that is not there.
    """
    allowed = sorted({peer.extra for peer in PEERS.values() if peer.served})
    for name, python in given.items():
        if name not in allowed:
            raise ValueError(
                f"peer-python: {name!r} is not one of {', '.join(allowed)}{suggestion(name, allowed)}"
            )
        if not Path(python).is_file():
            raise ValueError(f"peer-python: {name}: there is no Python {python!r}")
    return dict(given)


def missing_line(peer: Peer) -> str:
    """One line that says how a peer that is not installed is installed."""
    return f"{peer.name} is left out: pip install {peer.install}"


def is_missing(peer: Peer) -> bool:
    """Whether our own Python lacks a peer."""
    return find_spec(peer.package) is None

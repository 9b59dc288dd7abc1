# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A control law: its parameters theta, and the actions computed from them.

    a_k = law(theta, z_k, m_k, k),        m_{k+1} = update(theta, z_k, m_k, a_k, k),        m_0 = start

z_k is the measurement and m_k the law's memory, which most laws do not have. theta is one vector
with named parts. Optimisers, training, messages and files know theta and the law's name; only the law
knows what the parts mean. It is made from a reduced model s_{k+1} = A s_k + B a_k, s = U^T z:

>>> one = np.ones((1, 1))
>>> model = ModelRows(A=one, B=one, U=np.eye(3, 1), K_a=-0.5 * one, K_b=0.3 * one, s_r=one[0])
>>> class Saturating(Law):
...     "a = 0.5 tanh(2 (K s + b)): an action that never exceeds 0.5."
...
...     def start(self):
...         return {"K": self.model.K_a, "b": self.model.K_b @ self.model.s_r}
...
...     def action(self, theta, z, memory, k):
...         return 0.5 * np.tanh(2.0 * (theta["K"] @ self.reduced(z) + theta["b"]))
>>> law = Saturating(model, horizon=30)
>>> law.size, law.theta_start
(2, array([-0.5,  0.3]))
>>> law.action(law.parts(law.theta_start), np.array([1.0, 0.0, 0.0]), law.memory_start(), 0)
array([-0.18997448])
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, TypeAlias

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.settings import Settings as _Settings

Parts: TypeAlias = Mapping[str, Array]
"""The parts of theta by name, or a derivative by each of them."""


class Law(ABC):
    """Base class of control laws, for one reduced model.

    A derived class defines the initial theta and the action; everything else has defaults.
    A law handles one environment at a time. All methods are pure functions: the same arguments give
    the same bits, and nothing is kept between calls. theta = 0 must mean no control, a = 0, with which
    every law is compared. Actions need not respect the action limit: they are saturated before they
    are sent. Numbers that are not finite, or beyond 1e9, count as 1e9: the rollout diverges.

    Parameters
    ----------
    model : ModelRows
        The model of the plant: A, B, U, the LQ-tracking gains K_a and K_b, s_r = U^T z_r, and the
        filter gain L if the class is `filtered`.
    horizon : int
        Steps T of an episode. An action is also requested at k = T.

    Attributes
    ----------
    memory_size : int
        Size of the memory; 0: no memory.
    cost : Cost or None
        The plant's cost, if not just scalar weights and a constant target; set after `__init__`.

    Examples
    --------
    See the module. docs/bring-your-own.md has more.
    """

    name: ClassVar[str] = ""
    """Its name; that of the class if it is not set."""
    compiled: ClassVar[bool] = False
    """True if it has a compiled form: `gains`."""
    axes: ClassVar[int] = 1
    """Axes of theta in messages and files, where all laws but the affine one have a vector."""
    Settings: ClassVar[type[_Settings]] = _Settings
    """Its constants; none if it does not say otherwise."""
    settings: ClassVar[_Settings] = _Settings()
    """The constants of this training: parameters `law_settings.NAME`."""
    filtered: ClassVar[bool] = False
    """True if it uses the filter gain L, which its model then comes with (`model.L`)."""
    from_readings: ClassVar[str] = ""
    """Its preferred `identification` of a plant with few sensors; that of the optimiser if empty."""
    needs_model: ClassVar[bool] = False
    """True if its theta has a model of the plant, or is trained on one, so that only an optimiser that
    knows it can adapt it (`Optimizer.also_improves`)."""
    extends: ClassVar[bool] = False
    """True if its theta may be longer than `size`, by what an optimiser identified. Zeros at the end
    mean nothing, so that thetas of several lengths can stand in one array."""
    memory_size: int = 0
    cost: Cost | None = None

    def __init_subclass__(cls, **named: Any) -> None:
        super().__init_subclass__(**named)
        if "name" not in vars(cls):
            cls.name = cls.__name__
        if "Settings" in vars(cls):
            cls.settings = cls.Settings()

    def __init__(self, model: ModelRows, horizon: int) -> None:
        self.model, self.horizon = model, horizon

    @abstractmethod
    def start(self) -> Parts:
        """The initial theta by parts, whose names, shapes and order are those of theta.

        Returns
        -------
        dict of arrays
        """

    @abstractmethod
    def action(self, theta: Parts, z: Array, memory: Array, k: int) -> Array:
        """The action that answers a measurement.

        Parameters
        ----------
        theta : dict of arrays
            The parts, of the shapes of `start`.
        z : (n_z,)
            What is measured: the state, or the readings of sensors.
        memory : (memory_size,)
            m_k.
        k : int
            The step, 0 .. T.

        Returns
        -------
        (n_a,)
        """

    def memory_start(self) -> Array:
        """The memory at the beginning of an episode; zeros by default.

        Returns
        -------
        (memory_size,)
            m_0.
        """
        return np.zeros(self.memory_size)

    def memory_update(self, theta: Parts, z: Array, memory: Array, action: Array, k: int) -> Array:
        """The memory after a step; only for a law with a `memory_size`.

        Parameters
        ----------
        theta, z, memory, k : dict of arrays, (n_z,), (memory_size,), int
            As for `action`.
        action : (n_a,)
            The answered action, saturated where there is an action limit.

        Returns
        -------
        (memory_size,)
            m_{k+1}.

        Raises
        ------
        NotImplementedError
            The class has none.
        """
        raise NotImplementedError

    def pull_back(
        self, theta: Parts, z: Array, memory: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array]:
        """The transposed derivative of `action`; needed only for gradients.

        Parameters
        ----------
        theta, z, memory, k : dict of arrays, (n_z,), (memory_size,), int
            As for `action`.
        y : (n_a,)
            Any vector.

        Returns
        -------
        dict of arrays, (n_z,), (memory_size,)
            (da/dtheta)^T y by parts, (da/dz)^T y and (da/dm)^T y.

        Raises
        ------
        NotImplementedError
            The class has none.
        """
        raise NotImplementedError

    def pull_back_memory(
        self, theta: Parts, z: Array, memory: Array, action: Array, k: int, y: Array
    ) -> tuple[Parts, Array, Array, Array]:
        """The transposed derivative of `memory_update`: as `pull_back`.

        Parameters
        ----------
        theta, z, memory, action, k : dict of arrays, (n_z,), (memory_size,), (n_a,), int
            As for `memory_update`.
        y : (memory_size,)
            Any vector.

        Returns
        -------
        dict of arrays, (n_z,), (memory_size,), (n_a,)
            The derivatives by theta, z, m and a.

        Raises
        ------
        NotImplementedError
            The class has none.
        """
        raise NotImplementedError

    def gains(self, theta: Array) -> Array:
        """The compiled form: [K_a K_b] with a_k = K_a U^T z_k + K_b s_r at all steps.

        Parameters
        ----------
        theta : (size,)
            The whole vector.

        Returns
        -------
        (n_a, 2 n_s)

        Raises
        ------
        NotImplementedError
            The law has none.
        """
        raise NotImplementedError

    def has_gains(self, theta: Array) -> bool:
        """Whether a theta has the compiled form; by default, `compiled`.

        Parameters
        ----------
        theta : (size,)
            The whole vector, or a longer one if the law `extends`.

        Returns
        -------
        bool
        """
        return self.compiled

    def parts(self, theta: Array) -> Parts:
        """The parts of a vector theta, as views of it.

        Parameters
        ----------
        theta : (size,)
            The whole vector.

        Returns
        -------
        dict of arrays
        """
        found, begin = {}, 0
        for name, shape in self._shapes.items():
            size = int(np.prod(shape))
            found[name] = theta[begin : begin + size].reshape(shape)
            begin += size
        return found

    def vector(self, parts: Parts) -> Array:
        """The vector theta of its parts; the inverse of `parts`.

        Parameters
        ----------
        parts : dict of arrays
            With the names and shapes of `start`.

        Returns
        -------
        (size,)
        """
        return np.concatenate([np.zeros(0), *(np.ravel(parts[name]) for name in self._shapes)])

    def reduced(self, z: Array) -> Array:
        """The reduced state s = U^T z.

        Parameters
        ----------
        z : (n_z,)
            What is measured.

        Returns
        -------
        (n_s,)
        """
        s: Array = self.model.U.T @ z
        return s

    @property
    def n_a(self) -> int:
        """Size of an action."""
        return int(self.model.B.shape[1])

    @property
    def size(self) -> int:
        """Numbers of theta."""
        return len(self.theta_start)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of theta in messages and files, with `axes` axes."""
        return (self.size,)

    @cached_property
    def theta_start(self) -> Array:
        """`start` as a vector."""
        start = self.start().items()
        return self.vector({name: np.asarray(part, dtype=np.float64) for name, part in start})

    @cached_property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        return {name: np.shape(part) for name, part in self.start().items()}


def differentiable(kind: type[Law]) -> bool:
    """True if a law has all derivatives that an adjoint needs."""
    own = kind.pull_back is not Law.pull_back
    remembers = kind.memory_update is not Law.memory_update
    return own and (not remembers or kind.pull_back_memory is not Law.pull_back_memory)

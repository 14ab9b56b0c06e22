"""Which protocols a backend has, found out once: `isinstance` of one takes 10 us, which every call would pay."""

from turbopi.backends.base import Backend, Begins, Conditions, RunsBatches
from turbopi.models.pi0.conditioning import Form


class Abilities:
    """A backend as each protocol that it has, else None."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.begins = backend if isinstance(backend, Begins) else None
        self.runs_batches = backend if isinstance(backend, RunsBatches) else None
        self.conditions = backend if isinstance(backend, Conditions) else None

    @property
    def forms(self) -> tuple[Form, ...]:
        """What the denoising loop can be asked for beside openpi's."""
        return () if self.conditions is None else self.conditions.forms

"""Fields in the types and under the names that files hold."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ..arguments import shaped
from ..cloud import PointCloud
from ..failures import raise_at


def check_name(name: object, taken: list[str], suffix: str) -> None:
    if not isinstance(name, str):
        raise TypeError(f"fields has the name {name!r} ({type(name).__name__}), expected text")
    if name in taken:
        raise ValueError(f"the name {name!r} is taken by the cloud itself")
    if suffix != ".vtu" and name.split() != [name]:
        raise ValueError(f"{suffix[1:].upper()} allows no blanks in names of fields: {name!r}")
    if not (name and name.isprintable() and (suffix == ".vtu" or name.isascii())):
        raise ValueError(f"{suffix[1:].upper()} holds no field of the name {name!r}")


def in_space(name: str, field: object, cloud: PointCloud) -> np.ndarray:
    """A field as `(n,)` or `(n, c)` in types that files hold, with vectors in space."""
    try:
        value = np.asarray(field)
    except ValueError as error:  # ragged
        raise TypeError(f"field {name!r} is no array of numbers: {error}") from None
    n, d = cloud.n, cloud.dim
    shaped(value, f"field {name!r}", (n,), (n, "c"), (n, d, d))
    if value.dtype == bool:
        value = value.astype(np.uint8)
    if value.dtype.kind not in "iuf" and value.dtype != jnp.bfloat16:
        raise ValueError(f"field {name!r} holds {value.dtype}, expected real numbers")
    if value.dtype.itemsize == 2 and value.dtype.kind not in "iu":
        value = value.astype(np.float32)
    lack = 3 - cloud.dim
    if value.ndim == 3:
        return np.pad(value, ((0, 0), (0, lack), (0, lack))).reshape(cloud.n, 9)
    if value.ndim == 2 and value.shape[1] == cloud.dim:
        return np.pad(value, ((0, 0), (0, lack)))
    return value


def columns_of(data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Scalars with names that PLY allows."""
    columns: dict[str, np.ndarray] = {}
    for name, value in data.items():
        if value.dtype.itemsize == 8 and value.dtype.kind in "iu":
            most = np.iinfo(np.int32).max
            rows = value.reshape(len(value), -1)
            bad = np.any((rows < -most - 1) | (rows > most), axis=1)
            text = f"field {name!r} is {{v}} at point {{i}}: PLY holds integers up to {most}"
            raise_at(bad, text, value)
            value = value.astype(np.int32)
        if name == "normals":
            new = dict(zip(("nx", "ny", "nz"), value.T))
        elif value.ndim == 2:
            new = {f"{name}_{i}": column for i, column in enumerate(value.T)}
        else:
            new = {name: value}
        if twice := columns.keys() & new.keys():
            raise ValueError(f"two fields would have the name {twice.pop()!r} in a PLY file")
        columns |= new
    return columns

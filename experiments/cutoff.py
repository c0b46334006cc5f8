"""The papers' hard cut-off and ours."""

from __future__ import annotations

# Our kernels fall smoothly to zero at the support radius ρ. On the surface the surface DC-PSE
# kernel carries the taper (1 - (r/ρ)^8)^3 twice, and so is at half its strength at 0.76 ρ.
_HALF = (1 - 0.5 ** (1 / 6)) ** (1 / 8)


def smooth_support(cutoff: float) -> float:
    """Support radius of a kernel that is at half strength where the papers' is cut off."""
    return cutoff / _HALF

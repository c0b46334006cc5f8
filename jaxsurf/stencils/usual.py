"""The method of one who does not choose: of every public function that is given none.

The most accurate where a surface is smooth or coarse, and without growing modes on scans. Relative
l2 errors of the Laplacian, of `python -m experiments run choice`:

| method | genus 5, n = 2,500 | random sphere | torus, n = 4,000 | grows on scans |
|---|---|---|---|---|
| `DCPSE(order=2)` | .11 | 7.5e-3 | 1.5e-2 | no |
| `DCPSE(order=4)` | .16 | 2.2e-4 | 2.4e-3 | no |
| `GFDM(degree=2)` | .082 | 1.5e-2 | 1.4e-2 | no |
| `GFDM(degree=4)` | .019 | 1.5e-4 | 9.9e-4 | no |
| `GFDM(degree=5)` | .053 | 3.3e-5 | 1.2e-3 | no |
| `RBFFD(degree=4)` | .21 | 1.4e-4 | 9.9e-4 | yes |
"""

from .gfdm import GFDM

USUAL = GFDM(degree=4)

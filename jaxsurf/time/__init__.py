"""Problems in time, solvers for them, and the call that brings the two together."""

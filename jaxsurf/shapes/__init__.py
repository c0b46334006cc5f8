"""Where point clouds come from: closed formulas, level sets, meshes, and sampling for them all."""

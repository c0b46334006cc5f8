"""Partial differential equations on curved surfaces given as point clouds.

Points, then neighbours, then stencils, then operators: `import jaxsurf as js`.
"""

from .borders import Border as Border
from .borders import border_conormals as border_conormals
from .borders import detect_border as detect_border
from .borders import find_border as find_border
from .boundary import Closure as Closure
from .boundary import close as close
from .cells import SearchCapacity as SearchCapacity
from .cells import allocate as allocate
from .cells import search_neighbors as search_neighbors
from .cloud import PointCloud as PointCloud
from .conditions import Condition as Condition
from .conditions import dirichlet as dirichlet
from .conditions import neumann as neumann
from .conditions import robin as robin
from .curvature import gauss_curvature as gauss_curvature
from .curvature import mean_curvature as mean_curvature
from .curvature import mean_curvature_vector as mean_curvature_vector
from .curvature import principal_curvatures as principal_curvatures
from .curvature import shape_tensor as shape_tensor
from .frames import estimate_normals as estimate_normals
from .frames import from_points as from_points
from .frames import refit_normals as refit_normals
from .frames import tangent_frames as tangent_frames
from .ghosts import with_ghosts as with_ghosts
from .io import read as read
from .io import read_fields as read_fields
from .io import write as write
from .neighbors import Neighbors as Neighbors
from .neighbors import find_neighbors as find_neighbors
from .neighbors import tube_ratio as tube_ratio
from .operators import biharmonic as biharmonic
from .operators import choose_neighbors as choose_neighbors
from .operators import diffusion as diffusion
from .operators import directional_derivative as directional_derivative
from .operators import laplace_beltrami as laplace_beltrami
from .operators import partial_derivative as partial_derivative
from .operators import surface_divergence as surface_divergence
from .operators import surface_gradient as surface_gradient
from .plot import plot_cloud as plot_cloud
from .plot import plot_fields as plot_fields
from .shapes.analytic import circle as circle
from .shapes.analytic import ellipsoid as ellipsoid
from .shapes.analytic import graph as graph
from .shapes.analytic import sphere as sphere
from .shapes.analytic import surface_of_revolution as surface_of_revolution
from .shapes.analytic import torus as torus
from .shapes.implicit import double_torus as double_torus
from .shapes.implicit import level_set as level_set
from .shapes.implicit import level_set_curvature as level_set_curvature
from .shapes.implicit import level_set_normals as level_set_normals
from .shapes.implicit import project_to_level_set as project_to_level_set
from .shapes.meshes import TriangleMesh as TriangleMesh
from .shapes.meshes import clean_mesh as clean_mesh
from .shapes.meshes import sample_mesh as sample_mesh
from .shapes.order import sort_cloud as sort_cloud
from .shapes.sampling import jitter as jitter
from .shapes.sampling import poisson_disk as poisson_disk
from .solve.eigen import Eigenmodes as Eigenmodes
from .solve.eigen import eigenmodes as eigenmodes
from .spectrum import Spectrum as Spectrum
from .spectrum import spectral_estimate as spectral_estimate
from .stencils.dcpse import DCPSE as DCPSE
from .stencils.dcpse import FlatDCPSE as FlatDCPSE
from .stencils.gfdm import GFDM as GFDM
from .stencils.method import AbstractMethod as AbstractMethod
from .stencils.method import Diagnostics as Diagnostics
from .stencils.stencil import AbstractOperator as AbstractOperator
from .stencils.stencil import Composition as Composition
from .stencils.stencil import Stencil as Stencil

__version__ = "0.1.0"

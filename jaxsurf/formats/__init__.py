"""What files hold: raw points, faces, normals and fields, one function per format.

OBJ, OFF and XYZ are plain text and parsed here: common readers refuse textured OBJ files, drop
unused vertices or take a truncated file for a short one. PLY, STL and VTK go through meshio,
guarded against files that end early.
"""

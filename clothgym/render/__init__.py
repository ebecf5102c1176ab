"""Floor 6: pictures of sheets, from a small software rasterizer that draws the same picture on any machine.

It sees triangles, positions and colliders; it knows nothing of simulations or environments.
"""

from clothgym.render.camera import Camera
from clothgym.render.export import write_picture, write_video
from clothgym.render.meshes import MeshSequence, write_animation, write_meshes
from clothgym.render.renderer import Renderer
from clothgym.render.solids import Drawable, Drawn

__all__ = [
    "Camera",
    "Drawable",
    "Drawn",
    "MeshSequence",
    "Renderer",
    "write_animation",
    "write_meshes",
    "write_picture",
    "write_video",
]

"""Light transport as linear algebra: the operator T of a diffuse scene divided into patches, and (I - T)^-1 Le.

    op = transport.operator(scene, patches=2000)
    solution = op.solve()                                       # L = Le + T L on the patches
    image = transport.image(scene, op.radiosity(solution.L))    # through the camera, without noise

`operator` documents which scenes are supported, `operators.py` the discretisation and its errors. `radiance` looks up
light at a surface point within code for one ray, `Operator.control` lets paths end in it.
"""

from pathjax.transport.control import Control
from pathjax.transport.operators import METHODS, Operator, Solution, operator
from pathjax.transport.patches import Patches
from pathjax.transport.view import Radiosity, image, radiance

__all__ = ["METHODS", "Control", "Operator", "Patches", "Radiosity", "Solution", "image", "operator", "radiance"]

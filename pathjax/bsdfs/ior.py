"""Indices of refraction by name, for visible light under normal conditions, with Mitsuba's names and values."""

import numpy as np

# Least IOR, below that of any medium. Derivatives contain ninth powers of the ratio of two IORs: the seventh from
# Fresnel's terms, and the square from the ratio itself. float32 holds these up to an IOR of 80 on the other side.
LEAST_IOR = float(np.finfo(np.float32).tiny) ** (1 / 16)

IOR = {
    "vacuum": 1.0,
    "helium": 1.000036,
    "hydrogen": 1.000132,
    "air": 1.000277,
    "carbon dioxide": 1.00045,
    "water": 1.3330,
    "acetone": 1.36,
    "ethanol": 1.361,
    "carbon tetrachloride": 1.461,
    "glycerol": 1.4729,
    "benzene": 1.501,
    "silicone oil": 1.52045,
    "bromine": 1.661,
    "water ice": 1.31,
    "fused quartz": 1.458,
    "pyrex": 1.470,
    "acrylic glass": 1.49,
    "polypropylene": 1.49,
    "bk7": 1.5046,
    "sodium chloride": 1.544,
    "amber": 1.55,
    "pet": 1.5750,
    "diamond": 2.419,
}

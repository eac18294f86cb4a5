"""The paper, reproduced: Table 1, Figures 1 to 6, and its remark on triangles counted.

V. Zobel, J. Reininghaus, I. Hotz: “Visualization of Two-Dimensional Symmetric Positive Definite Tensor Fields Using the
Heat Kernel Signature”, Topological Methods in Data Analysis and Visualization III, 2014.
"""

from hks_jax.paper.reproduce import run as run

"""XLA's flags for programs that run for moments: ``python tests/compiler_flags.py`` prints them.

Programs wait for the compiler, which without these flags takes two to four times as long.
"""

import jaxlib

FLAGS = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
if jaxlib.__version__.startswith("0.10."):  # an unknown flag would be fatal
    FLAGS += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]

if __name__ == "__main__":
    print(*FLAGS)

"""How the tests compile: quickly, without optimisation; and how users do."""

from importlib.metadata import version

LEVEL_FLAG = "--xla_backend_optimization_level"
# Compiling what is not a kernel took four times as long with the newer emitters. From 0.11 on they cannot be left out.
OLD_EMITTERS = version("jaxlib").startswith("0.10.")

# Options of one program that undo the flags of ``quick_flags``.
USERS_OPTIONS = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False}
if OLD_EMITTERS:
    USERS_OPTIONS["xla_cpu_use_fusion_emitters"] = True


def quick_flags(level: str) -> list[str]:
    """XLA's flags for the whole process; those that help level 0 alone only there."""
    flags = [f"{LEVEL_FLAG}={level}"]
    if level == "0":
        flags.append("--xla_llvm_disable_expensive_passes=true")
        flags += ["--xla_cpu_use_fusion_emitters=false"] * OLD_EMITTERS
    return flags

"""How the tests compile: quickly, without optimisation; and how users do."""

import os
import subprocess
import sys
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


def at_level_0() -> bool:
    """Whether this process compiles without optimisation and with the older emitters."""
    return OLD_EMITTERS and f"{LEVEL_FLAG}=0" in os.environ.get("XLA_FLAGS", "")


def run_at_users_level(test: str) -> None:
    """One test in a process of its own that compiles as users do."""
    quick = quick_flags("0")
    flags = [flag for flag in os.environ.get("XLA_FLAGS", "").split() if flag not in quick]
    environment = {**os.environ, "XLA_FLAGS": " ".join(flags), "JAXGRASP_TEST_OPTIMIZATION": "3"}
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", "", "-p", "no:cacheprovider", test]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900, check=False)
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-1000:]

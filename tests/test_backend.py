"""Compiled programs are kept where the user expects, or nowhere."""

import jax
import pytest

from jaxgrasp.backend.device import remember_compilations


@pytest.fixture
def no_cache(monkeypatch):
    before = jax.config.jax_compilation_cache_dir
    seconds = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)


def test_programs_are_kept_in_the_cache_home_by_machine(no_cache, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    directory = remember_compilations()
    assert directory is not None
    assert directory.is_dir()
    assert directory.parent == tmp_path / "jaxgrasp"
    assert jax.config.jax_compilation_cache_dir == str(directory)
    assert remember_compilations() is None  # already set: the second call changes nothing


@pytest.mark.parametrize("value", ["", "/elsewhere"])
def test_the_users_setting_wins(no_cache, monkeypatch, tmp_path, value):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", value)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert remember_compilations() is None
    assert jax.config.jax_compilation_cache_dir is None
    assert not list(tmp_path.iterdir())


def test_a_home_that_cannot_be_written_is_no_obstacle(no_cache, monkeypatch, tmp_path):
    blocker = tmp_path / "file"
    blocker.write_text("not a directory")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocker))
    assert remember_compilations() is None
    assert jax.config.jax_compilation_cache_dir is None

"""Examples drawn by Hypothesis may take as long as a busy machine needs; the quick run draws fewer."""

from hypothesis import settings

settings.register_profile("suite", deadline=None)
settings.register_profile("quick", deadline=None, max_examples=40)


def _quick(config):
    return config.option.markexpr == "not slow"


def pytest_configure(config):
    settings.load_profile("quick" if _quick(config) else "suite")


def pytest_ignore_collect(collection_path, config):
    """Looking for doctests in scripts without any would import each of them, in each process: that is left out."""
    if not _quick(config) or collection_path.suffix != ".py":
        return None
    if collection_path.name.startswith("test_") or collection_path.name == "conftest.py":
        return None
    return ">>>" not in collection_path.read_text(encoding="utf-8") or None

"""Names of classes in configs, their `_target_`."""

RENAMED = {"pnu.models.": "pnu.networks."}  # in the configs of older runs and weights


def present_name(target: str) -> str:
    """The name that a class has now."""
    return next((new + target.removeprefix(old) for old, new in RENAMED.items() if target.startswith(old)), target)


def is_within(name: str, package: str) -> bool:
    """Whether a dotted name is that of a package or below it."""
    return bool(package) and f"{name}.".startswith(f"{package}.")

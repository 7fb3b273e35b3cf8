# Additions to the generated _core.pyi (nanobind's stub generator leaves out every name like __version__).
_core.__suffix__:
    __version__: str

"""A compiler that uses the widest vectors that the processor has."""

from typing import Any

from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering


class WideCompiler(CompilerBase):
    """Numba's compiler, whose loops become loops over vectors of 512 bits where there are any.

    By itself LLVM takes half of them for many of Intel's processors, whose clock they slowed down
    once.
    """

    def define_pipelines(self) -> list[PassManager]:
        """Return numba's passes, with another one that writes LLVM's code."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        own = {NativeLowering: _WideLowering}
        passes.passes = [(own.get(kind, kind), text) for kind, text in passes.passes]
        passes.finalize()
        return [passes]


class _WideLower(Lower):
    def setup_function(self, fndesc: Any) -> None:
        super().setup_function(fndesc)
        # The set itself refuses attributes with a value, which llvmlite does not know.
        set.add(self.function.attributes, '"prefer-vector-width"="512"')


@register_pass(mutates_CFG=True, analysis_only=False)
class _WideLowering(NativeLowering):
    _name = "wide_native_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        return _WideLower

# SPDX-License-Identifier: LGPL-3.0-or-later
"""Calling an FFCx kernel by its address from compiled code."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


@intrinsic
def call_kernel(  # type: ignore[no-untyped-def]
    typing_context, address, tensor, coefficients, constants, coordinates
) -> Any:
    """Call ``tabulate_tensor`` of a cell integral; all arguments are addresses.

    The two index arguments and the custom data of the UFCx signature are null: a cell integral on
    an affine triangle does not read them.
    """
    signature = types.void(address, tensor, coefficients, constants, coordinates)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        pointer = ir.IntType(8).as_pointer()
        function_type = ir.FunctionType(ir.VoidType(), [pointer] * 7)
        null = ir.Constant(pointer, None)
        function = builder.inttoptr(args[0], function_type.as_pointer())
        arrays = [builder.inttoptr(a, pointer) for a in args[1:]]
        builder.call(function, [*arrays, null, null, null])
        return context.get_dummy_value()

    return signature, codegen

// Conversions of vectors of eight, by truncation. The built-in functions are calls in PoCL 3.0, which does not inline its library, and a
// call in a loop puts all vectors on the stack; clang's operator is an instruction.
#ifndef VECTORS_H
#define VECTORS_H

#ifdef __clang__
#define TO_INTS(v) __builtin_convertvector(v, int8)
#define TO_FLOATS(v) __builtin_convertvector(v, float8)
#define TO_UCHARS(v) __builtin_convertvector(v, uchar8)
#define TO_USHORTS(v) __builtin_convertvector(v, ushort8)
#else
#define TO_INTS(v) convert_int8_rtz(v)
#define TO_FLOATS(v) convert_float8(v)
#define TO_UCHARS(v) convert_uchar8(v)
#define TO_USHORTS(v) convert_ushort8(v)
#endif

#endif

// A number in each lane of a vector register, under the name that CasADi's generated C has for a
// number. LIBMVEC is defined if the C library has vector functions of this width. One lane is plain
// C++, which CUDA compiles too; NUMBER is the type of its number.

#ifdef __CUDACC_RTC__
#define INFINITY (10.0 * 1e308)
#else
#include <math.h>
#include <stdlib.h>
#endif

#if LANES == 1
typedef bool Bits;

struct Numbers {
  NUMBER number;
  Numbers() = default;
  constexpr Numbers(NUMBER number) : number(number) {}
  constexpr operator NUMBER() const { return number; }
  NUMBER &operator[](int) { return number; }
  NUMBER operator[](int) const { return number; }
};
#else
typedef double Numbers __attribute__((vector_size(8 * LANES)));
typedef long long Bits __attribute__((vector_size(8 * LANES)));
#endif

struct V {
  Numbers x;
  V() = default;
#if LANES == 1
  constexpr V(double each) : x(NUMBER(each)) {}
#else
  V(double each) : x(each - Numbers{}) {}
#endif
  explicit V(Numbers given) : x(given) {}
};

#ifdef __CUDACC_RTC__
#define INLINE static __forceinline__
#else
#define INLINE static inline __attribute__((always_inline))
#endif

#if LANES == 1
INLINE V flag(Bits is_true) { return V(is_true ? 1.0 : 0.0); }
#else
INLINE V flag(Bits true_where) {
  return V((Numbers)(true_where & (Bits)(1.0 - Numbers{})));
}
#endif
INLINE V operator+(V a, V b) { return V(a.x + b.x); }
INLINE V operator-(V a, V b) { return V(a.x - b.x); }
INLINE V operator*(V a, V b) { return V(a.x * b.x); }
INLINE V operator/(V a, V b) { return V(a.x / b.x); }
INLINE V operator-(V a) { return V(-a.x); }
INLINE V &operator+=(V &a, V b) { return a = a + b; }
INLINE V &operator-=(V &a, V b) { return a = a - b; }
INLINE V &operator*=(V &a, V b) { return a = a * b; }
INLINE V &operator/=(V &a, V b) { return a = a / b; }
INLINE V operator<(V a, V b) { return flag(a.x < b.x); }
INLINE V operator>(V a, V b) { return flag(a.x > b.x); }
INLINE V operator<=(V a, V b) { return flag(a.x <= b.x); }
INLINE V operator>=(V a, V b) { return flag(a.x >= b.x); }
INLINE V operator==(V a, V b) { return flag(a.x == b.x); }
INLINE V operator!=(V a, V b) { return flag(a.x != b.x); }
INLINE V operator!(V a) { return a == V(0.0); }
INLINE V operator&&(V a, V b) { return flag((a.x != 0.0) & (b.x != 0.0)); }
INLINE V operator||(V a, V b) { return flag((a.x != 0.0) | (b.x != 0.0)); }
// NaN is ignored, as by the functions of the C library.
INLINE V fmin(V a, V b) { return V((a.x < b.x) | (b.x != b.x) ? a.x : b.x); }
INLINE V fmax(V a, V b) { return V((a.x > b.x) | (b.x != b.x) ? a.x : b.x); }

#define LANE_BY_LANE(NAME) \
  INLINE V NAME(V a) { \
    V r; \
    for (int i = 0; i < LANES; ++i) r.x[i] = NAME((NUMBER)a.x[i]); \
    return r; \
  }
#define LANE_BY_LANE_OF_TWO(NAME) \
  INLINE V NAME(V a, V b) { \
    V r; \
    for (int i = 0; i < LANES; ++i) r.x[i] = NAME((NUMBER)a.x[i], (NUMBER)b.x[i]); \
    return r; \
  }

#if LANES == 1
LANE_BY_LANE(fabs)
INLINE V where(V condition, V value) { return condition.x != 0.0 ? value : V(0.0); }
#else
INLINE V fabs(V a) {
  return V((Numbers)((Bits)a.x & (Bits){} + 0x7fffffffffffffffLL));
}
INLINE V where(V condition, V value) {
  return V((Numbers)((Bits)(condition.x != 0.0) & (Bits)value.x));
}
#endif

#ifdef LIBMVEC
extern "C" Numbers VECTOR_SIN(Numbers);
extern "C" Numbers VECTOR_COS(Numbers);
extern "C" Numbers VECTOR_LOG(Numbers);
INLINE V sin(V a) { return V(VECTOR_SIN(a.x)); }
INLINE V cos(V a) { return V(VECTOR_COS(a.x)); }
INLINE V log(V a) { return V(VECTOR_LOG(a.x)); }
#else
LANE_BY_LANE(sin)
LANE_BY_LANE(cos)
LANE_BY_LANE(log)
#endif

#if LANES == 8 && defined(__AVX512F__)
#include <immintrin.h>
INLINE V sqrt(V a) { return V((Numbers)_mm512_sqrt_pd((__m512d)a.x)); }
#elif LANES == 4 && defined(__AVX__)
#include <immintrin.h>
INLINE V sqrt(V a) { return V((Numbers)_mm256_sqrt_pd((__m256d)a.x)); }
#elif LANES == 2 && defined(__SSE2__)
#include <emmintrin.h>
INLINE V sqrt(V a) { return V((Numbers)_mm_sqrt_pd((__m128d)a.x)); }
#else
LANE_BY_LANE(sqrt)
#endif

LANE_BY_LANE(tan)
LANE_BY_LANE(asin)
LANE_BY_LANE(acos)
LANE_BY_LANE(atan)
LANE_BY_LANE(exp)
LANE_BY_LANE_OF_TWO(atan2)
LANE_BY_LANE_OF_TWO(pow)

// CasADi's helpers are for old compilers unless they say that they are not.
#undef __STDC_VERSION__
#define __STDC_VERSION__ 199901L

/* Greatest instructions and stack of single calls on a Cortex-M4 in QEMU with -icount shift=3.
 *
 * There, each instruction takes 8 ns of the time of the board, and SysTick runs at 25 MHz: one tick
 * is 5 instructions, and a count may be off by one tick. It has 24 bits: a call of more than 84
 * million instructions is said to take so many. On a host, nothing is measured.
 */
#ifndef MAPLINES_EXAMPLES_MEASURE_H
#define MAPLINES_EXAMPLES_MEASURE_H

#include <stdint.h>
#include <stdio.h>

#ifdef __arm__
#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010U)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014U)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018U)
#define SYSTICK_MOST 0xFFFFFFU
#define SYSTICK_WRAPPED 0x10000U // since the control was read, or the value was set
#define TICK 5U                  // instructions
#define PAINTED 0x8000U          // bytes of the stack that are painted
#define PAINT 0xA5C3F00DU

typedef struct {
    uint32_t ticks; ///< greatest of all calls, as is the stack
    uint32_t stack; ///< [byte]
    uint32_t calls;
    uint32_t start;
    uint32_t *sp;
} measurement_t;

/// Paint the memory below the stack pointer, and start the clock.
__attribute__((always_inline)) static inline void measure_begin(measurement_t *m)
{
    uint32_t *sp;
    __asm volatile("mov %0, sp" : "=r"(sp));
    m->sp = sp;
    for (uint32_t *word = sp - PAINTED / 4U; word < sp; ++word)
    {
        *word = PAINT;
    }
    SYSTICK_RELOAD = SYSTICK_MOST;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 5; // from the clock of the CPU, without an interrupt
    m->start = SYSTICK_VALUE;
}

/// Stop the clock, and find how far the paint is gone.
__attribute__((always_inline)) static inline void measure_end(measurement_t *m)
{
    uint32_t ticks = (m->start - SYSTICK_VALUE) & SYSTICK_MOST;
    ticks = (SYSTICK_CONTROL & SYSTICK_WRAPPED) != 0 ? SYSTICK_MOST : ticks;
    m->ticks = ticks > m->ticks ? ticks : m->ticks;
    ++m->calls;
    const uint32_t *word = m->sp - PAINTED / 4U;
    while (word < m->sp && *word == PAINT)
    {
        ++word;
    }
    const uint32_t stack = (uint32_t)((m->sp - word) * 4);
    m->stack = stack > m->stack ? stack : m->stack;
}

/// Add a measurement to those of the same kind.
static inline void measure_add(measurement_t *all, const measurement_t *m)
{
    all->ticks = m->ticks > all->ticks ? m->ticks : all->ticks;
    all->stack = m->stack > all->stack ? m->stack : all->stack;
    all->calls += m->calls;
}

static inline void measure_print(const char *name, const measurement_t *m)
{
    if (m->calls > 0)
    {
        printf("# %s: %lu instructions, %lu bytes of stack, %lu calls\n", name,
               (unsigned long)(m->ticks * TICK), (unsigned long)m->stack, (unsigned long)m->calls);
    }
}
#else
typedef int measurement_t;
#define measure_begin(m) ((void)(m))
#define measure_end(m) ((void)(m))
#define measure_add(all, m) ((void)(all), (void)(m))
#define measure_print(name, m) ((void)(name), (void)(m))
#endif

#endif

/* Start of a program on a Cortex-M4F: vectors, memory, the FPU; and an end by semihosting. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define MAX_ARGUMENTS 8

extern char data_start[], data_end[], data_load[], bss_start[], bss_end[], stack_top[];
extern int main(int argc, char **argv);
extern void initialise_monitor_handles(void);
void reset(void);
static void fault(void);

/// Initial stack pointer, and the handlers of the core's exceptions.
__attribute__((section(".vectors"), used)) static const uintptr_t vectors[16] = {
    (uintptr_t)stack_top, (uintptr_t)reset, (uintptr_t)fault, (uintptr_t)fault,
    (uintptr_t)fault,     (uintptr_t)fault, (uintptr_t)fault,
};

/// Words of the command line, as the debugger or emulator has it (SYS_GET_CMDLINE).
static int read_arguments(char **argv)
{
    static char line[512];
    struct {
        char *text;
        uint32_t size;
    } block = {line, sizeof line};
    register uint32_t operation __asm("r0") = 0x15;
    register void *argument __asm("r1") = &block;
    __asm volatile("bkpt 0xAB" : "+r"(operation) : "r"(argument) : "memory");
    int argc = 0;
    for (char *word = strtok(line, " "); word != NULL && argc < MAX_ARGUMENTS;
         word = strtok(NULL, " "))
    {
        argv[argc] = word;
        ++argc;
    }
    return argc;
}

void reset(void)
{
    char *argv[MAX_ARGUMENTS + 1] = {NULL};
    *(volatile uint32_t *)0xE000ED88U |= 0xFU << 20U; // CPACR: use the FPU
    __asm volatile("dsb\n isb");
    memcpy(data_start, data_load, (size_t)(data_end - data_start));
    memset(bss_start, 0, (size_t)(bss_end - bss_start));
    initialise_monitor_handles(); // files and the terminal are those of the host
    const int argc = read_arguments(argv);
    exit(main(argc, argv));
}

static void fault(void)
{
    abort();
}

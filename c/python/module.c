/* The module maplines_can._native: what it was built with. */
#include <Python.h>

#include "maplines.h"

#if defined(__clang__)
#define COMPILER __VERSION__ // begins with the name
#elif defined(__GNUC__)
#define COMPILER "GCC " __VERSION__
#elif defined(_MSC_VER)
#define COMPILER "Microsoft C"
#else
#define COMPILER "an unknown compiler"
#endif

static int add_all(PyObject *module)
{
    if (PyModule_AddStringConstant(module, "version", MAPLINES_VERSION) < 0)
    {
        return -1;
    }
    return PyModule_AddStringConstant(module, "compiler", COMPILER);
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, (void *)add_all},
#ifdef Py_mod_gil
    {Py_mod_gil, Py_MOD_GIL_NOT_USED}, // there is no state
#endif
    {0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .m_name = "maplines_can._native",
    .m_doc = "What the core was built with.",
    .m_slots = slots,
};

PyMODINIT_FUNC PyInit__native(void);

PyMODINIT_FUNC PyInit__native(void)
{
    return PyModuleDef_Init(&definition);
}

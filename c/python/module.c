/* The module maplines_can._native. */
#include "native.h"

#if defined(__clang__)
#define COMPILER __VERSION__ // begins with the name
#elif defined(__GNUC__)
#define COMPILER "GCC " __VERSION__
#elif defined(_MSC_VER)
#define COMPILER "Microsoft C"
#else
#define COMPILER "an unknown compiler"
#endif

maplines_module_t *maplines_module_state(PyObject *module)
{
    return (maplines_module_t *)PyModule_GetState(module);
}

static int add_all(PyObject *module)
{
    static int (*const parts[])(PyObject *) = {
        maplines_add_names,
        maplines_add_tables,
    };
    for (size_t i = 0; i < sizeof parts / sizeof parts[0]; i++)
    {
        if (parts[i](module) < 0)
        {
            return -1;
        }
    }
    if (PyModule_AddStringConstant(module, "version", MAPLINES_VERSION) < 0)
    {
        return -1;
    }
    return PyModule_AddStringConstant(module, "compiler", COMPILER);
}

static int traverse(PyObject *module, visitproc visit, void *arg)
{
    maplines_module_t *state = maplines_module_state(module);
    Py_VISIT(state->tables);
    for (int i = 0; i < MAPLINES_OBJECTS; ++i)
    {
        Py_VISIT(state->objects[i]);
    }
    return 0;
}

static int clear(PyObject *module)
{
    maplines_module_t *state = maplines_module_state(module);
    Py_CLEAR(state->tables);
    for (int i = 0; i < MAPLINES_OBJECTS; ++i)
    {
        Py_CLEAR(state->objects[i]);
    }
    return 0;
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, (void *)add_all},
#ifdef Py_mod_gil
    {Py_mod_gil, Py_MOD_GIL_USED}, // objects have no locks of their own
#endif
    {0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .m_name = "maplines_can._native",
    .m_doc = "C core of maplines for the Python package, which says what its functions do.",
    .m_size = sizeof(maplines_module_t),
    .m_slots = slots,
    .m_traverse = traverse,
    .m_clear = clear,
};

PyObject *maplines_module_of(PyObject *object)
{
    PyObject *module = PyType_GetModule(Py_TYPE(object));
    PyErr_Clear(); // of a type of no module
    // The state of another module has other members.
    const bool is_own = module != NULL && PyModule_GetDef(module) == &definition;
    PyErr_Clear();
    return is_own ? module : NULL;
}

PyMODINIT_FUNC PyInit__native(void);

PyMODINIT_FUNC PyInit__native(void)
{
    return PyModuleDef_Init(&definition);
}

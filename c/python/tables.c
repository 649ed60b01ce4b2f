/* Tables of a DBC that the Python package has made: see maplines_can.wire.c_tables. */
#include "native.h"

static PyObject *tables_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"address", "owner", NULL};
    PyObject *address = NULL;
    PyObject *owner = NULL;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "O!O:Tables", names, &PyLong_Type, &address,
                                     &owner))
    {
        return NULL;
    }
    const maplines_dbc_t *dbc = PyLong_AsVoidPtr(address);
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    maplines_tables_t *tables =
        PyErr_Occurred() == NULL ? (maplines_tables_t *)allocate(type, 0) : NULL;
    if (tables != NULL)
    {
        tables->dbc = dbc;
        tables->owner = Py_NewRef(owner);
    }
    return (PyObject *)tables;
}

static void tables_dealloc(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    Py_XDECREF(((maplines_tables_t *)self)->owner);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyType_Slot tables_slots[] = {
    {Py_tp_new, (void *)tables_new},
    {Py_tp_dealloc, (void *)tables_dealloc},
    {Py_tp_doc, (void *)"Tables of a DBC: their address, and the object that owns them."},
    {0, NULL},
};

static PyType_Spec tables_spec = {
    .name = "maplines_can._native.Tables",
    .basicsize = sizeof(maplines_tables_t),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = tables_slots,
};

const maplines_dbc_t *maplines_dbc_of(PyObject *module, PyObject *tables)
{
    if (module == NULL || !PyObject_TypeCheck(tables, maplines_module_state(module)->tables))
    {
        PyErr_SetString(PyExc_TypeError, "tables must be _native.Tables");
        return NULL;
    }
    return ((maplines_tables_t *)tables)->dbc;
}

int maplines_add_tables(PyObject *module)
{
    maplines_module_t *state = maplines_module_state(module);
    state->tables = (PyTypeObject *)PyType_FromModuleAndSpec(module, &tables_spec, NULL);
    return state->tables == NULL ? -1 : PyModule_AddType(module, state->tables);
}

/* What C uses of the package: names of attributes. */
#include "native.h"

int maplines_add_names(PyObject *module)
{
    static const char *const names[MAPLINES_NAMES] = {
        [MAPLINES_NAME_AGE] = "age",
        [MAPLINES_NAME_COMPONENTS] = "components",
        [MAPLINES_NAME_CORRELATION_TIME] = "correlation_time",
        [MAPLINES_NAME_COV] = "cov",
        [MAPLINES_NAME_FIT_RANGES] = "fit_ranges",
        [MAPLINES_NAME_GAUSSIAN] = "gaussian",
        [MAPLINES_NAME_HEADING_SIGMA] = "heading_sigma",
        [MAPLINES_NAME_KIND] = "kind",
        [MAPLINES_NAME_LEFT_OUT] = "left_out",
        [MAPLINES_NAME_LINES] = "lines",
        [MAPLINES_NAME_MAP_ERROR] = "map_error",
        [MAPLINES_NAME_MEAN] = "mean",
        [MAPLINES_NAME_MIXTURE] = "mixture",
        [MAPLINES_NAME_OFFSET_SIGMA] = "offset_sigma",
        [MAPLINES_NAME_POINT_SIGMA] = "point_sigma",
        [MAPLINES_NAME_POSE] = "pose",
        [MAPLINES_NAME_POSE_ERROR] = "pose_error",
        [MAPLINES_NAME_QUARTICS] = "quartics",
        [MAPLINES_NAME_SLOT] = "slot",
        [MAPLINES_NAME_SPECIFIC_COVS] = "specific_covs",
        [MAPLINES_NAME_STATUS] = "status",
        [MAPLINES_NAME_T_NS] = "t_ns",
        [MAPLINES_NAME_WEIGHTS] = "weights",
        [MAPLINES_NAME_X_MAX] = "x_max",
        [MAPLINES_NAME_X_MIN] = "x_min",
    };
    PyObject **objects = maplines_module_state(module)->objects;
    for (int i = 0; i < MAPLINES_NAMES; ++i)
    {
        objects[i] = PyUnicode_InternFromString(names[i]);
        if (objects[i] == NULL)
        {
            return -1;
        }
    }
    return 0;
}

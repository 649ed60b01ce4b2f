/* Names of the values of enumerations.
 *
 * Input: nothing. Output: rows "ENUMERATION NUMBER NAME" of all numbers that have a name.
 */
#include "harness_dbc.h"

#include <stdio.h>
#include <string.h>

static void print(const char *enumeration, int number, const char *name)
{
    if (strcmp(name, "?") != 0)
    {
        (void)printf("%s %d %s\n", enumeration, number, name);
    }
}

int main(void)
{
    for (int i = -3; i < 300; ++i)
    {
        print("owner", i, maplines_owner_name((maplines_owner_t)i));
        print("kind", i, maplines_kind_name((maplines_kind_t)i));
        print("status", i, maplines_status_name((maplines_status_t)i));
        print("reason", i, maplines_reason_name((maplines_reason_t)i));
        print("e2e_state", i, maplines_e2e_state_name((maplines_e2e_state_t)i));
        print("e2e_status", i, maplines_e2e_status_name((maplines_e2e_status_t)i));
        print("prediction", i, maplines_prediction_name((maplines_prediction_t)i));
        print("refusal", i, maplines_refusal_name((maplines_refusal_t)i));
        print("left_out", i, maplines_left_out_name((maplines_left_out_t)i));
    }
    return harness_dbc.name == NULL ? 1 : 0;
}

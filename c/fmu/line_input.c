/* Inputs of a sender: lines, each with its covariance.
 *
 * Setting an input of a slot publishes its line: it is sent from then on, with an age that grows,
 * in place of the one before. A slot that is not valid sends nothing.
 */
#include "fmu.h"

#include <string.h>

size_t maplines_scratch_size(void)
{
    return 0;
}

const char *maplines_start_input(maplines_instance_t *instance)
{
    (void)instance;
    return NULL;
}

void maplines_note_input(maplines_node_t *node, fmi3ValueReference first, size_t index)
{
    size_t slot = (index - FLAG_SLOTS) / SLOT_FLAGS;
    if (first == MAPLINES_FIRST_REAL)
    {
        slot = (index - REAL_SLOTS) / SLOT_REALS;
    }
    else if (first == MAPLINES_FIRST_CHOICE)
    {
        slot = (index - CHOICE_SLOTS) / SLOT_CHOICES;
    }
    node->set |= (uint32_t)1 << slot;
}

/// Read the line of a slot from the inputs.
static void read_line(const maplines_values_t *values, int slot, maplines_input_t *line)
{
    const double *reals = &values->reals[REAL_SLOTS + SLOT_REALS * slot];
    const int64_t *choices = &values->choices[CHOICE_SLOTS + SLOT_CHOICES * slot];
    const double *entry = &reals[SLOT_REAL_COV];
    memset(line, 0, sizeof *line);
    line->slot = (maplines_owner_t)slot;
    line->kind = (maplines_kind_t)choices[SLOT_CHOICE_KIND];
    line->status = (maplines_status_t)choices[SLOT_CHOICE_STATUS];
    line->x_min = reals[SLOT_REAL_X_MIN];
    line->x_max = reals[SLOT_REAL_X_MAX];
    line->age = reals[SLOT_REAL_AGE];
    line->has_age = true;
    for (int i = 0; i < 4; i++)
    {
        line->mean[i] = reals[SLOT_REAL_MEAN + i];
        for (int j = 0; j <= i; j++)
        {
            line->cov[i][j] = *entry;
            line->cov[j][i] = *entry;
            entry++;
        }
    }
}

void maplines_take_inputs(maplines_instance_t *instance)
{
    const maplines_values_t *values = &instance->state.values;
    maplines_node_t *node = &instance->state.node;
    for (int slot = 0; slot < MAPLINES_SLOTS && node->set != 0; slot++)
    {
        if ((node->set >> slot & 1U) != 0)
        {
            maplines_input_t line;
            read_line(values, slot, &line);
            const bool is_valid = values->flags[FLAG_SLOTS + SLOT_FLAGS * slot + SLOT_FLAG_VALID];
            if (is_valid && line.age >= 0.0)
            {
                maplines_publish(&node->queue, &line, instance->state.now);
            }
            else
            {
                maplines_drop(&node->queue, slot);
            }
            if (is_valid && !(line.age >= 0.0))
            {
                maplines_refuse(instance, slot, MAPLINES_BAD_AGE);
            }
        }
    }
    node->set = 0;
}

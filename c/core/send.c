/* Lines and scenes to records, for the Python package, which makes frames of them. */
#include "core.h"
#include "internal.h"

/// Greatest entry of a covariance of a caller, and longest finite age [s].
static const double greatest_cov = 1e307;
static const double longest_age = 1e99;

/// Doubles of a mean and of its covariance, one after the other.
#define GAUSSIAN 20

/// Whether a Gaussian over a line is finite, and its covariance exactly symmetric.
static bool is_gaussian(const double *gaussian)
{
    const double *cov = &gaussian[4];
    bool is_good = true;
    for (int i = 0; i < 4; i++)
    {
        is_good = is_good && fabs(gaussian[i]) < (double)INFINITY && cov[5 * i] >= 0.0;
    }
    for (int i = 0; i < 16; i++)
    {
        const double mirrored = cov[4 * (i % 4) + i / 4];
        is_good =
            is_good && fabs(cov[i]) <= greatest_cov && cov[i] >= mirrored && cov[i] <= mirrored;
    }
    return is_good;
}

/// Read all of a line but its Gaussian; false if a value is none that a line has.
static bool read_line(const maplines_dbc_t *dbc, const maplines_given_line_t *given,
                      maplines_input_t *line)
{
    const bool is_known = given->slot >= 0 && given->slot < MAPLINES_SLOTS && given->kind >= 0 &&
                          given->kind <= (int)MAPLINES_VIRTUAL && given->status >= 0 &&
                          given->status <= (int)MAPLINES_OUT_OF_RANGE;
    memset(line, 0, sizeof *line);
    if (!is_known || !(maplines_has_whole_scenes(dbc) || dbc->messages[given->slot].is_present))
    {
        return false;
    }
    line->slot = (maplines_owner_t)given->slot;
    line->kind = (maplines_kind_t)given->kind;
    line->status = (maplines_status_t)given->status;
    line->x_min = given->x_min;
    line->x_max = given->x_max;
    line->age = given->age;
    line->has_age = true;
    return maplines_check_input(line) == MAPLINES_SENT;
}

/// Seal a record with the counter of its owner, which advances.
static void seal(const maplines_dbc_t *dbc, int owner, uint8_t *record, size_t length,
                 int64_t *counter)
{
    const uint32_t mask = maplines_counter_mask(maplines_layout(dbc, owner));
    const uint32_t number = (uint32_t)((uint64_t)*counter & mask);
    maplines_seal(dbc, owner, record, length, number);
    *counter = (int64_t)maplines_next_counter(dbc, owner, number);
}

/* ---- lines ----------------------------------------------------------------------------------- */

/// Read the components of a mixture, and what each must cover besides; false if it cannot be sent.
static bool read_mixture(const maplines_dbc_t *dbc, int count, const double *gaussians,
                         const double *given_weights, double *weights, double cover[16])
{
    maplines_component_t components[MAPLINES_MAX_COMPONENTS];
    double total = 0.0;
    bool is_good = count >= 1 && count <= dbc->max_components && count <= MAPLINES_MAX_COMPONENTS &&
                   count - 1 <= maplines_raw_max(&dbc->component_index);
    for (int i = 0; is_good && i < count; i++)
    {
        const double *gaussian = &gaussians[GAUSSIAN * i];
        components[i].weight = given_weights[i];
        memcpy(components[i].mean, gaussian, sizeof components[i].mean);
        memcpy(components[i].cov[0], &gaussian[4], sizeof components[i].cov);
        total += given_weights[i];
        is_good = given_weights[i] > 0.0 && given_weights[i] < 2.0;
    }
    is_good = is_good && fabs(total - 1.0) < 1e-8;
    if (is_good)
    {
        maplines_cover_mixture(dbc, components, count, weights, cover);
    }
    return is_good;
}

/// Write the records of a line; false if it is unusual. It is a mixture if it has weights.
static bool write_line(const maplines_dbc_t *dbc, const double *const *powers,
                       const maplines_given_line_t *given, int count, const double *gaussians,
                       const double *given_weights, int64_t *counter, uint8_t *records)
{
    const size_t length = 8U * (size_t)dbc->line.pages;
    double weights[MAPLINES_MAX_COMPONENTS] = {1.0};
    maplines_input_t line;
    maplines_draft_t draft;
    bool is_good = read_line(dbc, given, &line);
    for (int i = 0; is_good && i < count; i++)
    {
        is_good = is_gaussian(&gaussians[GAUSSIAN * i]);
    }
    memset(&draft, 0, sizeof draft);
    draft.line = &line;
    draft.count = count;
    draft.weight = 1.0;
    draft.powers = powers;
    if (is_good && given_weights != NULL)
    {
        is_good = read_mixture(dbc, count, gaussians, given_weights, weights, draft.cover);
    }
    for (int i = 0; is_good && i < count; i++)
    {
        uint8_t *record = &records[length * (size_t)i];
        draft.mean = &gaussians[GAUSSIAN * i];
        memcpy(draft.cov, &draft.mean[4], sizeof draft.cov);
        draft.index = i;
        draft.weight = given_weights != NULL ? weights[i] : 1.0;
        memset(record, 0, length);
        (void)maplines_write_complete(dbc, &draft, record);
        seal(dbc, given->slot, record, length, counter);
    }
    return is_good;
}

bool maplines_write_lines(const maplines_dbc_t *dbc, const double *const *powers, size_t n,
                          const maplines_given_line_t *lines, const int32_t *components,
                          const double *gaussians, const double *weights,
                          int64_t counters[MAPLINES_OWNERS], uint8_t *records)
{
    const size_t length = 8U * (size_t)dbc->line.pages;
    bool is_good = !dbc->is_conditional;
    size_t place = 0;
    for (size_t i = 0; is_good && i < n; i++)
    {
        const int slot = lines[i].slot;
        const bool is_mixture = components != NULL && components[i] > 0;
        const int count = is_mixture ? components[i] : 1;
        is_good = slot >= 0 && slot < MAPLINES_SLOTS &&
                  write_line(dbc, powers, &lines[i], count, &gaussians[GAUSSIAN * place],
                             is_mixture ? &weights[place] : NULL, &counters[slot],
                             &records[length * place]);
        place += (size_t)count;
    }
    return is_good;
}

/* ---- scenes ---------------------------------------------------------------------------------- */

/// Whether numbers are finite; what is too large to be sent is left out, or does not fit.
static bool are_finite(const double *numbers, size_t count)
{
    bool are = true;
    for (size_t i = 0; i < count; i++)
    {
        are = are && fabs(numbers[i]) < (double)INFINITY;
    }
    return are;
}

/// Copy a scene whose values are usual; false if one is not.
static bool read_scene(const maplines_dbc_t *dbc, const maplines_given_scene_t *given,
                       maplines_scene_input_t *input, maplines_input_t lines[MAPLINES_SLOTS])
{
    const size_t n = given->count;
    bool is_used[MAPLINES_SLOTS] = {false};
    bool is_good = dbc->has_pose && n <= MAPLINES_SLOTS && are_finite(given->fit_ranges, 2U * n) &&
                   are_finite(given->quartics, n) && are_finite(given->cov, 16U * n * n) &&
                   are_finite(given->pose_cov, 9) &&
                   (given->specific == NULL || are_finite(given->specific, 16U * n)) &&
                   given->correlation_time > 0.0 && given->offset_sigma >= 0.0 &&
                   given->offset_sigma < (double)INFINITY && given->heading_sigma >= 0.0 &&
                   given->heading_sigma < (double)INFINITY;
    memset(input, 0, sizeof *input);
    input->count = (uint8_t)(is_good ? n : 0U);
    for (size_t i = 0; is_good && i < n; i++)
    {
        const double *gaussian = &given->gaussians[GAUSSIAN * i];
        const double *range = &given->fit_ranges[2U * i];
        maplines_scene_line_t *line = &input->lines[i];
        is_good = read_line(dbc, &given->lines[i], &lines[i]) && is_gaussian(gaussian) &&
                  !is_used[lines[i].slot] && range[0] < range[1];
        is_used[lines[i].slot] = true;
        memcpy(lines[i].mean, gaussian, sizeof lines[i].mean);
        line->slot = lines[i].slot;
        line->kind = lines[i].kind;
        line->status = lines[i].status;
        line->x_min = lines[i].x_min;
        line->x_max = lines[i].x_max;
        line->quartic = given->quartics[i];
        memcpy(line->mean, gaussian, sizeof line->mean);
        memcpy(line->fit_range, range, sizeof line->fit_range);
        if (given->specific != NULL)
        {
            memcpy(line->specific[0], &given->specific[16U * i], sizeof line->specific);
        }
    }
    for (size_t row = 0; is_good && row < 4U * n; row++)
    {
        memcpy(input->cov[row], &given->cov[4U * n * row], 4U * n * sizeof input->cov[0][0]);
    }
    memcpy(input->pose_cov[0], given->pose_cov, sizeof input->pose_cov);
    input->has_specific = given->specific != NULL;
    input->correlation_time = given->correlation_time;
    input->offset_sigma = given->offset_sigma;
    input->heading_sigma = given->heading_sigma;
    return is_good;
}

/// Set all bits of a signal to 0.
static void clear_signal(const maplines_signal_t *signal, uint8_t *record, size_t length)
{
    uint8_t mask[MAPLINES_MAX_RECORD] = {0};
    maplines_put(signal, mask, -1);
    for (size_t i = 0; i < length; i++)
    {
        record[i] = (uint8_t)(record[i] & ~(unsigned)mask[i]);
    }
}

/// Write the record of a line as far as it does not change from cycle to cycle. One of a whole
/// scene has no record of its own.
static void write_template(const maplines_dbc_t *dbc, const maplines_input_t *line,
                           const double *cov, const maplines_scene_member_t *member,
                           maplines_template_t *record)
{
    record->slot = (uint8_t)line->slot;
    record->length = 0;
    record->is_there = !dbc->is_conditional || member->left_out == MAPLINES_IN_SCENE;
    if (!record->is_there || maplines_has_whole_scenes(dbc))
    {
        return;
    }
    if (dbc->is_conditional)
    {
        record->length = (uint8_t)maplines_write_conditional(dbc, member, record->bytes);
    }
    else
    {
        maplines_draft_t draft;
        memset(&draft, 0, sizeof draft);
        draft.line = line;
        draft.mean = line->mean;
        memcpy(draft.cov, cov, sizeof draft.cov);
        draft.count = 1;
        draft.weight = 1.0;
        record->length = (uint8_t)(8 * dbc->line.pages);
        (void)maplines_write_complete(dbc, &draft, record->bytes);
        clear_signal(&dbc->age, record->bytes, record->length);
    }
}

int maplines_prepare_scene(const maplines_dbc_t *dbc, const maplines_given_scene_t *scene,
                           bool is_full, maplines_prepared_t *prepared)
{
    maplines_scene_input_t input;
    maplines_input_t lines[MAPLINES_SLOTS];
    if (!read_scene(dbc, scene, &input, lines))
    {
        return -1;
    }
    const maplines_refusal_t refusal = maplines_encode_members(
        dbc, &input, is_full && maplines_has_entries(dbc), &prepared->space);
    if (refusal != MAPLINES_SENT)
    {
        return (int)refusal;
    }
    prepared->count = input.count;
    for (int i = 0; i < (int)input.count; i++)
    {
        write_template(dbc, &lines[i], &scene->gaussians[GAUSSIAN * i + 4],
                       &prepared->space.members[i], &prepared->records[i]);
    }
    return (int)MAPLINES_SENT;
}

static bool is_age(double age)
{
    return age >= 0.0 && (age <= longest_age || isinf(age));
}

bool maplines_write_scene(const maplines_dbc_t *dbc, const maplines_prepared_t *prepared, size_t n,
                          const uint8_t *slots, const double ages[MAPLINES_OWNERS],
                          int64_t counters[MAPLINES_OWNERS], uint8_t lengths[MAPLINES_OWNERS],
                          uint8_t *records)
{
    const int pose = (int)MAPLINES_POSE;
    const maplines_template_t *record = prepared->records;
    const maplines_template_t *const end = &record[prepared->count];
    size_t place = 8U * (size_t)dbc->pose.pages;
    maplines_pose_cycle_t cycle;
    memset(&cycle, 0, sizeof cycle);
    cycle.age = ages[pose];
    bool is_good = is_age(cycle.age);
    for (int owner = 0; owner < MAPLINES_OWNERS; owner++)
    {
        cycle.first[owner] = (uint32_t)counters[owner];
    }
    for (size_t i = 0; is_good && i < n; i++)
    {
        while (record != end && record->slot != slots[i])
        {
            ++record;
        }
        is_good =
            record != end && record->is_there && (dbc->is_conditional || is_age(ages[slots[i]]));
        if (!is_good)
        {
            break;
        }
        const int slot = (int)record->slot;
        uint8_t *bytes = &records[place];
        const maplines_scene_member_t *member =
            &prepared->space.members[record - prepared->records];
        cycle.is_member[slot] = member->left_out == MAPLINES_IN_SCENE;
        memcpy(bytes, record->bytes, record->length);
        if (!dbc->is_conditional)
        {
            const double age = maplines_raw_above(&dbc->age, 1000.0 * ages[slot]);
            maplines_put(&dbc->age, bytes, maplines_limited(&dbc->age, age));
        }
        seal(dbc, slot, bytes, record->length, &counters[slot]);
        lengths[i + 1U] = record->length;
        place += record->length;
    }
    if (is_good)
    {
        memset(records, 0, 8U * (size_t)dbc->pose.pages);
        for (int slot = 0; slot < MAPLINES_SLOTS; slot++)
        {
            cycle.following[slot] = (uint32_t)counters[slot];
        }
        lengths[0] = (uint8_t)maplines_write_pose(dbc, &prepared->space, &cycle, records);
        seal(dbc, pose, records, lengths[0], &counters[pose]);
    }
    return is_good;
}

static maplines_whole_cycle_t whole_cycle(const maplines_prepared_t *prepared, uint32_t slots,
                                          bool is_secured)
{
    const maplines_whole_cycle_t cycle = {.space = &prepared->space,
                                          .count = (int)prepared->count,
                                          .slots = slots,
                                          .is_secured = is_secured};
    return cycle;
}

void maplines_place_lines(const maplines_dbc_t *dbc, const maplines_prepared_t *prepared,
                          uint32_t slots, bool is_secured, maplines_chosen_places_t *places)
{
    const maplines_whole_cycle_t cycle = whole_cycle(prepared, slots, is_secured);
    maplines_choose_places(dbc, &cycle, places);
}

size_t maplines_write_whole_scene(const maplines_dbc_t *dbc, const maplines_prepared_t *prepared,
                                  uint32_t slots, bool is_secured,
                                  const double ages[MAPLINES_OWNERS],
                                  int64_t counters[MAPLINES_OWNERS],
                                  maplines_chosen_places_t *places, uint8_t lengths[2],
                                  uint8_t *records)
{
    const int first = (int)MAPLINES_SCENE;
    maplines_whole_cycle_t cycle = whole_cycle(prepared, slots, is_secured);
    if (!is_age(ages[first]) || !is_age(ages[first + 1]))
    {
        return 0;
    }
    size_t count = 0;
    maplines_choose_places(dbc, &cycle, places);
    cycle.counter = (uint32_t)counters[first];
    for (int message = places->sends_scene2 ? 1 : 0; message >= 0; message--)
    {
        const int owner = first + message;
        cycle.age = ages[owner];
        lengths[count] = (uint8_t)maplines_write_whole(dbc, &cycle, places, message, records);
        seal(dbc, owner, records, lengths[count], &counters[owner]);
        records += lengths[count];
        count++;
    }
    return count;
}

/// MAC that was given; without one its data is kept.
static bool given_mac(void *context, uint8_t key_id, const uint8_t *data, size_t length,
                      uint8_t mac[16])
{
    maplines_signing_t *signing = context;
    (void)key_id;
    if (signing->mac != NULL)
    {
        memcpy(mac, signing->mac, 16);
        return true;
    }
    signing->size = (uint8_t)length;
    memcpy(signing->data, data, length);
    return false;
}

size_t maplines_sign(maplines_signing_t *signing, size_t length, const uint8_t *record,
                     int64_t now_us, const uint8_t *mac)
{
    signing->signer.mac = given_mac;
    signing->signer.context = signing;
    signing->mac = mac;
    return maplines_secured_pdu(&signing->layout, signing->data_id, record, length, now_us,
                                &signing->signer, signing->pdu);
}

/* Names of the values of enumerations, as the Python package has them.
 *
 * They stand in arrays of characters: pointers to them would be data that is relocated.
 */
#include "internal.h"

#define COUNT(names) ((int)(sizeof(names) / sizeof((names)[0])))
#define NAME_SIZE 16 // of the longest, UNAUTHENTICATED

static const char slot_names[][NAME_SIZE] = {"EGO_LEFT", "EGO_RIGHT", "NEXT_LEFT",  "NEXT_RIGHT",
                                             "CENTRE",   "EDGE_LEFT", "EDGE_RIGHT", "ROUTE"};
static const char owner_names[][NAME_SIZE] = {"POSE", "SCENE", "SCENE2"}; // that are no slots
static const char kind_names[][NAME_SIZE] = {"UNKNOWN",   "SOLID", "DASHED",  "DOUBLE",
                                             "ROAD_EDGE", "KERB",  "BARRIER", "VIRTUAL"};
static const char status_names[][NAME_SIZE] = {"UNKNOWN",  "FULL",      "DIAGONAL",
                                               "REPAIRED", "SATURATED", "OUT_OF_RANGE"};
#if MAPLINES_RECEIVER
/// From MAPLINES_COMPLETE on, which is -1.
static const char reason_names[][NAME_SIZE] = {
    "COMPLETE",        "PENDING",    "FOREIGN", "LENGTH", "PAGE", "DUPLICATE", "REPLACED",
    "STALE",           "INCOMPLETE", "TIMEOUT", "MIXED",  "CRC",  "CONTENT",   "POSE",
    "UNAUTHENTICATED", "KEY",        "MAC",     "REPLAY", "AGE",  "SPACING"};
static const char e2e_state_names[][NAME_SIZE] = {"VALID", "?", "NODATA", "INIT", "INVALID"};
static const struct {
    maplines_e2e_status_t status;
    char name[NAME_SIZE];
} e2e_statuses[] = {
    {MAPLINES_E2E_OK, "OK"},
    {MAPLINES_E2E_NONEWDATA, "NONEWDATA"},
    {MAPLINES_E2E_ERROR, "ERROR"},
    {MAPLINES_E2E_REPEATED, "REPEATED"},
    {MAPLINES_E2E_OKSOMELOST, "OKSOMELOST"},
    {MAPLINES_E2E_WRONGSEQUENCE, "WRONGSEQUENCE"},
    {MAPLINES_E2E_NONE, "NONE"},
};
static const char prediction_names[][NAME_SIZE] = {"PREDICTED", "NOT_USABLE", "TOO_FAR",
                                                   "BAD_MOTION", "ILL_POSED"};
#endif
#if MAPLINES_SENDER
static const char refusal_names[][NAME_SIZE] = {
    "SENT",         "NO_MESSAGE",  "NO_COVARIANCE", "BAD_MEAN",     "BAD_COVARIANCE",
    "BAD_VARIANCE", "ASYMMETRIC",  "BAD_RANGE",     "BAD_AGE",      "BAD_KIND",
    "BAD_STATUS",   "BAD_WEIGHTS", "BAD_COUNT",     "NO_SIGNATURE", "INDEFINITE",
    "SAME_SLOT",    "BAD_POSE",    "UNSEEN",        "BAD_CALL"};
#endif
#if MAPLINES_SCENES
static const char left_out_names[][NAME_SIZE] = {"IN_SCENE", "ACROSS",     "RANGE",
                                                 "MEAN",     "COVARIANCE", "PLACE"};
#endif

/// The name at place i; "?" if there is none.
static const char *name_at(const char (*names)[NAME_SIZE], int count, int i)
{
    return i >= 0 && i < count ? names[i] : "?";
}

const char *maplines_owner_name(maplines_owner_t owner)
{
    if (owner >= MAPLINES_POSE)
    {
        return name_at(owner_names, COUNT(owner_names), (int)owner - (int)MAPLINES_POSE);
    }
    return name_at(slot_names, MAPLINES_SLOTS, (int)owner);
}

const char *maplines_kind_name(maplines_kind_t kind)
{
    return name_at(kind_names, COUNT(kind_names), (int)kind);
}

const char *maplines_status_name(maplines_status_t status)
{
    return name_at(status_names, COUNT(status_names), (int)status);
}

#if MAPLINES_RECEIVER
const char *maplines_reason_name(maplines_reason_t reason)
{
    return name_at(reason_names, COUNT(reason_names), (int)reason - (int)MAPLINES_COMPLETE);
}

const char *maplines_e2e_state_name(maplines_e2e_state_t state)
{
    return name_at(e2e_state_names, COUNT(e2e_state_names), (int)state);
}

const char *maplines_e2e_status_name(maplines_e2e_status_t status)
{
    const char *name = "?";
    for (int i = 0; i < COUNT(e2e_statuses); ++i)
    {
        if (e2e_statuses[i].status == status)
        {
            name = e2e_statuses[i].name;
        }
    }
    return name;
}

const char *maplines_prediction_name(maplines_prediction_t prediction)
{
    return name_at(prediction_names, COUNT(prediction_names), (int)prediction);
}
#endif

#if MAPLINES_SENDER
const char *maplines_refusal_name(maplines_refusal_t refusal)
{
    return name_at(refusal_names, COUNT(refusal_names), (int)refusal);
}
#endif

#if MAPLINES_SCENES
const char *maplines_left_out_name(maplines_left_out_t left_out)
{
    return name_at(left_out_names, COUNT(left_out_names), (int)left_out);
}
#endif

/* Names of the values of enumerations, as the Python package has them. */
#include "internal.h"

#define COUNT(names) ((int)(sizeof(names) / sizeof((names)[0])))

static const char *const owner_names[] = {"EGO_LEFT",   "EGO_RIGHT", "NEXT_LEFT",
                                          "NEXT_RIGHT", "CENTRE",    "EDGE_LEFT",
                                          "EDGE_RIGHT", "ROUTE",     "POSE"};
static const char *const kind_names[] = {"UNKNOWN",   "SOLID", "DASHED",  "DOUBLE",
                                         "ROAD_EDGE", "KERB",  "BARRIER", "VIRTUAL"};
static const char *const status_names[] = {"UNKNOWN",  "FULL",      "DIAGONAL",
                                           "REPAIRED", "SATURATED", "OUT_OF_RANGE"};
/// From MAPLINES_COMPLETE on, which is -1.
static const char *const reason_names[] = {
    "COMPLETE",        "PENDING",    "FOREIGN", "LENGTH", "PAGE", "DUPLICATE", "REPLACED",
    "STALE",           "INCOMPLETE", "TIMEOUT", "MIXED",  "CRC",  "CONTENT",   "POSE",
    "UNAUTHENTICATED", "KEY",        "MAC",     "REPLAY", "AGE"};
static const char *const e2e_state_names[] = {"VALID", "?", "NODATA", "INIT", "INVALID"};
static const char *const prediction_names[] = {"PREDICTED", "NOT_USABLE", "TOO_FAR", "BAD_MOTION",
                                               "ILL_POSED"};
static const char *const refusal_names[] = {
    "SENT",       "NO_MESSAGE",   "NO_COVARIANCE", "BAD_MEAN",  "BAD_COVARIANCE", "BAD_VARIANCE",
    "ASYMMETRIC", "BAD_RANGE",    "BAD_AGE",       "BAD_KIND",  "BAD_STATUS",     "BAD_WEIGHTS",
    "BAD_COUNT",  "NO_SIGNATURE", "INDEFINITE",    "SAME_SLOT", "BAD_POSE",       "UNSEEN"};
static const char *const left_out_names[] = {"IN_SCENE", "ACROSS", "RANGE", "MEAN", "COVARIANCE"};

/// The name at place i; "?" if there is none.
static const char *name_at(const char *const *names, int count, int i)
{
    return i >= 0 && i < count ? names[i] : "?";
}

const char *maplines_owner_name(maplines_owner_t owner)
{
    return name_at(owner_names, COUNT(owner_names), (int)owner);
}

const char *maplines_kind_name(maplines_kind_t kind)
{
    return name_at(kind_names, COUNT(kind_names), (int)kind);
}

const char *maplines_status_name(maplines_status_t status)
{
    return name_at(status_names, COUNT(status_names), (int)status);
}

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
    switch (status)
    {
    case MAPLINES_E2E_OK:
        name = "OK";
        break;
    case MAPLINES_E2E_NONEWDATA:
        name = "NONEWDATA";
        break;
    case MAPLINES_E2E_ERROR:
        name = "ERROR";
        break;
    case MAPLINES_E2E_REPEATED:
        name = "REPEATED";
        break;
    case MAPLINES_E2E_OKSOMELOST:
        name = "OKSOMELOST";
        break;
    case MAPLINES_E2E_WRONGSEQUENCE:
        name = "WRONGSEQUENCE";
        break;
    case MAPLINES_E2E_NONE:
        name = "NONE";
        break;
    default:
        // no status
        break;
    }
    return name;
}

const char *maplines_prediction_name(maplines_prediction_t prediction)
{
    return name_at(prediction_names, COUNT(prediction_names), (int)prediction);
}

const char *maplines_refusal_name(maplines_refusal_t refusal)
{
    return name_at(refusal_names, COUNT(refusal_names), (int)refusal);
}

const char *maplines_left_out_name(maplines_left_out_t left_out)
{
    return name_at(left_out_names, COUNT(left_out_names), (int)left_out);
}

/* What maplines.h makes of the sizes of a build: their checks, and the names of all functions.
 *
 * maplines.h includes this file. Nothing in it is to be called or set.
 */
#ifndef MAPLINES_BUILD_H
#define MAPLINES_BUILD_H

/* ---- checks ------------------------------------------------------------------------------------
 */

#if MAPLINES_RECEIVER < 0 || MAPLINES_RECEIVER > 1 || MAPLINES_SENDER < 0 ||                       \
    MAPLINES_SENDER > 1 || MAPLINES_SCENES < 0 || MAPLINES_SCENES > 1 || MAPLINES_SECOC < 0 ||     \
    MAPLINES_SECOC > 1 || MAPLINES_FLOAT < 0 || MAPLINES_FLOAT > 1
#error "MAPLINES_RECEIVER, _SENDER, _SCENES, _SECOC and _FLOAT must be 0 or 1"
#endif
#if MAPLINES_LINE_RECORDS < 0 || MAPLINES_LINE_RECORDS > 1 || MAPLINES_SCENE_RECORDS < 0 ||        \
    MAPLINES_SCENE_RECORDS > 1
#error "MAPLINES_LINE_RECORDS and MAPLINES_SCENE_RECORDS must be 0 or 1"
#endif
#if MAPLINES_LINE_RECORDS + MAPLINES_SCENE_RECORDS == 0
#error "maplines without MAPLINES_LINE_RECORDS and MAPLINES_SCENE_RECORDS has nothing: set one to 1"
#endif
#if MAPLINES_SCENE_RECORDS && !MAPLINES_SCENES
#error "MAPLINES_SCENE_RECORDS 1 needs MAPLINES_SCENES 1"
#endif
#if !MAPLINES_LINE_RECORDS && MAPLINES_MAX_COMPONENTS > 1
#error                                                                                             \
    "MAPLINES_MAX_COMPONENTS must be 1 without MAPLINES_LINE_RECORDS: whole scenes have no mixtures"
#endif
#if MAPLINES_RECEIVER + MAPLINES_SENDER == 0
#error "maplines without MAPLINES_RECEIVER and MAPLINES_SENDER has nothing: set one to 1"
#endif
#if MAPLINES_SLOTS < 1 || MAPLINES_SLOTS > 8
#error "MAPLINES_SLOTS must be from 1 to 8"
#endif
#if MAPLINES_MAX_PAGES < 1 || MAPLINES_MAX_PAGES > 16
#error "MAPLINES_MAX_PAGES must be from 1 to 16"
#endif
#if MAPLINES_MAX_TRANSFER_IDS < 1 || MAPLINES_MAX_TRANSFER_IDS > 256
#error "MAPLINES_MAX_TRANSFER_IDS must be from 1 to 256"
#endif
#if MAPLINES_MAX_COMPONENTS < 1 || MAPLINES_MAX_COMPONENTS > 64
#error "MAPLINES_MAX_COMPONENTS must be from 1 to 64"
#endif
#if MAPLINES_TRANSFERS < 1 || MAPLINES_TRANSFERS > 256 ||                                          \
    (MAPLINES_TRANSFERS & (MAPLINES_TRANSFERS - 1)) != 0
#error "MAPLINES_TRANSFERS must be a power of 2 from 1 to 256"
#endif
#if MAPLINES_HISTORY < 2 || MAPLINES_HISTORY > 65536 ||                                            \
    (MAPLINES_HISTORY & (MAPLINES_HISTORY - 1)) != 0
#error "MAPLINES_HISTORY must be a power of 2 from 2 to 65536"
#endif
#if MAPLINES_EPOCHS < 1 || MAPLINES_EPOCHS > 126
#error "MAPLINES_EPOCHS must be from 1 to 126"
#endif
#if MAPLINES_WINDOW < 1 || MAPLINES_WINDOW > 255
#error "MAPLINES_WINDOW must be from 1 to 255"
#endif

/* ---- names -------------------------------------------------------------------------------------
 * The names of all functions and tables have the build, so that files which do not agree on it do
 * not link. In a name, each number stands behind its macro: "maplines_y_double_receiver1_..." was
 * compiled with MAPLINES_RECEIVER 1, "lines" and "whole" are of MAPLINES_LINE_RECORDS and
 * _SCENE_RECORDS, "pages", "ids" and "components" of MAPLINES_MAX_PAGES, _MAX_TRANSFER_IDS and
 * _MAX_COMPONENTS. Define MAPLINES_NAMESPACE to have two libraries of one
 * build in a program.
 */
#ifndef MAPLINES_NAMESPACE
#define MAPLINES_NAMESPACE maplines
#endif
#if MAPLINES_FLOAT
#define MAPLINES_REAL float
#else
#define MAPLINES_REAL double
#endif
#ifndef MAPLINES_NAME
#define MAPLINES_NAME(name)                                                                        \
    MAPLINES_NAMED(MAPLINES_NAMESPACE, name, MAPLINES_REAL, MAPLINES_RECEIVER, MAPLINES_SENDER,    \
                   MAPLINES_SCENES, MAPLINES_LINE_RECORDS, MAPLINES_SCENE_RECORDS, MAPLINES_SECOC, \
                   MAPLINES_SLOTS, MAPLINES_MAX_PAGES, MAPLINES_MAX_TRANSFER_IDS,                  \
                   MAPLINES_MAX_COMPONENTS, MAPLINES_TRANSFERS, MAPLINES_HISTORY, MAPLINES_EPOCHS, \
                   MAPLINES_WINDOW)
#define MAPLINES_NAMED(space, name, real, receiver, sender, scenes, lines, whole, secoc, slots,    \
                       pages, ids, components, transfers, history, epochs, window)                 \
    MAPLINES_JOINED(space, name, real, receiver, sender, scenes, lines, whole, secoc, slots,       \
                    pages, ids, components, transfers, history, epochs, window)
// clang-format off
#define MAPLINES_JOINED(space, name, real, receiver, sender, scenes, lines, whole, secoc, slots,   \
                        pages, ids, components, transfers, history, epochs, window)                \
    space##_##name##_##real##_receiver##receiver##_sender##sender##_scenes##scenes                 \
    ##_lines##lines##_whole##whole##_secoc##secoc##_slots##slots##_pages##pages##_ids##ids         \
    ##_components##components##_transfers##transfers##_history##history##_epochs##epochs           \
    ##_window##window
// clang-format on
#endif
#define maplines_decoder_init MAPLINES_NAME(decoder_init)
#define maplines_decoder_init_default MAPLINES_NAME(decoder_init_default)
#define maplines_feed MAPLINES_NAME(feed)
#define maplines_latest MAPLINES_NAME(latest)
#define maplines_copy_line MAPLINES_NAME(copy_line)
#define maplines_newest MAPLINES_NAME(newest)
#define maplines_component MAPLINES_NAME(component)
#define maplines_expire MAPLINES_NAME(expire)
#define maplines_is_valid_at MAPLINES_NAME(is_valid_at)
#define maplines_y MAPLINES_NAME(y)
#define maplines_y_sigma MAPLINES_NAME(y_sigma)
#define maplines_y_extrapolated MAPLINES_NAME(y_extrapolated)
#define maplines_slope MAPLINES_NAME(slope)
#define maplines_curvature MAPLINES_NAME(curvature)
#define maplines_covariance MAPLINES_NAME(covariance)
#define maplines_mahalanobis MAPLINES_NAME(mahalanobis)
#define maplines_latest_scene MAPLINES_NAME(latest_scene)
#define maplines_copy_scene MAPLINES_NAME(copy_scene)
#define maplines_scene_line MAPLINES_NAME(scene_line)
#define maplines_sum MAPLINES_NAME(sum)
#define maplines_width MAPLINES_NAME(width)
#define maplines_centre MAPLINES_NAME(centre)
#define maplines_common_range MAPLINES_NAME(common_range)
#define maplines_joint_covariance MAPLINES_NAME(joint_covariance)
#define maplines_displacement MAPLINES_NAME(displacement)
#define maplines_predict_gaussian MAPLINES_NAME(predict_gaussian)
#define maplines_predict MAPLINES_NAME(predict)
#define maplines_overall MAPLINES_NAME(overall)
#define maplines_predict_to MAPLINES_NAME(predict_to)
#define maplines_slot_stats MAPLINES_NAME(slot_stats)
#define maplines_statistics MAPLINES_NAME(statistics)
#define maplines_default_e2e MAPLINES_NAME(default_e2e)
#define maplines_default_settings MAPLINES_NAME(default_settings)
#define maplines_settings_for MAPLINES_NAME(settings_for)
#define maplines_encoder_init MAPLINES_NAME(encoder_init)
#define maplines_encode_line MAPLINES_NAME(encode_line)
#define maplines_encode_mixture MAPLINES_NAME(encode_mixture)
#define maplines_encode_scene MAPLINES_NAME(encode_scene)
#define maplines_self_test MAPLINES_NAME(self_test)
#define maplines_owner_name MAPLINES_NAME(owner_name)
#define maplines_kind_name MAPLINES_NAME(kind_name)
#define maplines_status_name MAPLINES_NAME(status_name)
#define maplines_reason_name MAPLINES_NAME(reason_name)
#define maplines_e2e_state_name MAPLINES_NAME(e2e_state_name)
#define maplines_e2e_status_name MAPLINES_NAME(e2e_status_name)
#define maplines_prediction_name MAPLINES_NAME(prediction_name)
#define maplines_refusal_name MAPLINES_NAME(refusal_name)
#define maplines_left_out_name MAPLINES_NAME(left_out_name)

#endif

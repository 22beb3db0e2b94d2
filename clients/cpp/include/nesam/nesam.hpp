#pragma once

// Everything of the client.

#include <nesam/alarm.hpp>
#include <nesam/alarm_watch.hpp>
#include <nesam/array.hpp>
#include <nesam/client.hpp>
#include <nesam/diagnosis.hpp>
#include <nesam/durable_stream.hpp>
#include <nesam/effect.hpp>
#include <nesam/error.hpp>
#include <nesam/extras.hpp>
#include <nesam/fallback.hpp>
#include <nesam/fleet_soil.hpp>
#include <nesam/measurement.hpp>
#include <nesam/measurement_stream.hpp>
#include <nesam/motion_model.hpp>
#include <nesam/prediction.hpp>
#include <nesam/prediction_stream.hpp>
#include <nesam/session.hpp>
#include <nesam/session_status.hpp>
#include <nesam/soil_watch.hpp>
#include <nesam/span.hpp>
#include <nesam/terrain.hpp>
#include <nesam/tls.hpp>
#include <nesam/types.hpp>

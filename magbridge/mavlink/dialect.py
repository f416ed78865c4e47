"""Our messages, and those that pymavlink's wheel lacks: written by tools/dialect.py."""

from __future__ import annotations

import struct
from typing import Dict

from pymavlink.dialects.v20.all import MAVLink_message, mavlink_msg_deprecated_name_property

MAVLINK_MSG_ID_MAG_RAW = 60100
MAVLINK_MSG_ID_MAG_FIELD = 60101
MAVLINK_MSG_ID_MAG_STATUS = 60102
MAVLINK_MSG_ID_MAG_NAVIGATION = 60103
MAVLINK_MSG_ID_MAG_SENSOR_BYTES = 60104
MAVLINK_MSG_ID_MAG_LINK_BYTES = 60105
MAVLINK_MSG_ID_MAG_BRIDGE_START = 60106
MAVLINK_MSG_ID_MAG_CLOCK_STEP = 60107
MAVLINK_MSG_ID_MAG_PORT = 60108
MAVLINK_MSG_ID_MAG_COLUMN = 60109
MAVLINK_MSG_ID_MAG_HOST_STALL = 60110
MAVLINK_MSG_ID_MAG_LEARNING = 60111
MAVLINK_MSG_ID_MAG_SENSOR = 60112
MAVLINK_MSG_ID_MAG_SIGNING_STREAM = 60120
MAVLINK_MSG_ID_MAG_INTERLEAVED = 60121
MAVLINK_MSG_ID_COMPONENT_INFORMATION_BASIC = 396
MAVLINK_MSG_ID_COMPONENT_METADATA = 397
MAVLINK_MSG_ID_TIMESYNC = 111


class MAVLink_mag_raw_message(MAVLink_message):
    """
    One triple of channels as the instrument gave it, uncorrected, in
    sensor axes (x forward, y starboard, z down).
    """

    id = MAVLINK_MSG_ID_MAG_RAW
    msgname = "MAG_RAW"
    fieldnames = ["time_usec", "sequence", "x", "y", "z", "count_x", "count_y", "count_z", "delay_x", "delay_y", "delay_z", "temperature", "supply", "power_cycle", "sensor_id", "flags"]
    ordered_fieldnames = ["time_usec", "sequence", "x", "y", "z", "count_x", "count_y", "count_z", "delay_x", "delay_y", "delay_z", "temperature", "supply", "power_cycle", "sensor_id", "flags"]
    fieldtypes = ["uint64_t", "uint32_t", "float", "float", "float", "int32_t", "int32_t", "int32_t", "int32_t", "int32_t", "int32_t", "float", "float", "uint16_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {"flags": "bitmask"}
    fieldenums_by_name: Dict[str, str] = {"flags": "MAG_RAW_FLAGS"}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "x": "nT", "y": "nT", "z": "nT", "delay_x": "us", "delay_y": "us", "delay_z": "us", "temperature": "degC", "supply": "V"}
    native_format = bytearray(b"<QIfffiiiiiiffHBB")
    orders = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    crc_extra = 156
    unpacker = struct.Struct("<QIfffiiiiiiffHBB")
    instance_field = "sensor_id"
    instance_offset = 58

    def __init__(self, time_usec: int, sequence: int, x: float, y: float, z: float, count_x: int, count_y: int, count_z: int, delay_x: int, delay_y: int, delay_z: int, temperature: float, supply: float, power_cycle: int, sensor_id: int, flags: int):
        MAVLink_message.__init__(self, MAVLink_mag_raw_message.id, MAVLink_mag_raw_message.msgname)
        self._fieldnames = MAVLink_mag_raw_message.fieldnames
        self._instance_field = MAVLink_mag_raw_message.instance_field
        self._instance_offset = MAVLink_mag_raw_message.instance_offset
        self.time_usec = time_usec
        self.sequence = sequence
        self.x = x
        self.y = y
        self.z = z
        self.count_x = count_x
        self.count_y = count_y
        self.count_z = count_z
        self.delay_x = delay_x
        self.delay_y = delay_y
        self.delay_z = delay_z
        self.temperature = temperature
        self.supply = supply
        self.power_cycle = power_cycle
        self.sensor_id = sensor_id
        self.flags = flags

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.sequence, self.x, self.y, self.z, self.count_x, self.count_y, self.count_z, self.delay_x, self.delay_y, self.delay_z, self.temperature, self.supply, self.power_cycle, self.sensor_id, self.flags), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_raw_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_field_message(MAVLink_message):
    """
    One corrected sample, all channels at one time, in body axes
    (sensor axes while MAG_QUALITY_NO_BORESIGHT is set).
    """

    id = MAVLINK_MSG_ID_MAG_FIELD
    msgname = "MAG_FIELD"
    fieldnames = ["time_usec", "total_field", "sequence", "calibration_id", "total_field_sigma", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z", "anomaly", "telemetry_age", "latency", "flags", "sensor_id", "magnetic_heading", "heading", "heading_sigma"]
    ordered_fieldnames = ["time_usec", "total_field", "sequence", "calibration_id", "total_field_sigma", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z", "anomaly", "telemetry_age", "latency", "flags", "sensor_id", "magnetic_heading", "heading", "heading_sigma"]
    fieldtypes = ["uint64_t", "double", "uint32_t", "uint32_t", "float", "float", "float", "float", "float", "float", "float", "float", "float", "float", "uint16_t", "uint8_t", "float", "float", "float"]
    fielddisplays_by_name: Dict[str, str] = {"flags": "bitmask"}
    fieldenums_by_name: Dict[str, str] = {"flags": "MAG_QUALITY"}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "total_field": "nT", "total_field_sigma": "nT", "x": "nT", "y": "nT", "z": "nT", "sigma_x": "nT", "sigma_y": "nT", "sigma_z": "nT", "anomaly": "nT", "telemetry_age": "s", "latency": "s", "magnetic_heading": "deg", "heading": "deg", "heading_sigma": "deg"}
    native_format = bytearray(b"<QdIIffffffffffHBfff")
    orders = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    crc_extra = 213
    unpacker = struct.Struct("<QdIIffffffffffHBfff")
    instance_field = "sensor_id"
    instance_offset = 66

    def __init__(self, time_usec: int, total_field: float, sequence: int, calibration_id: int, total_field_sigma: float, x: float, y: float, z: float, sigma_x: float, sigma_y: float, sigma_z: float, anomaly: float, telemetry_age: float, latency: float, flags: int, sensor_id: int, magnetic_heading: float = 0, heading: float = 0, heading_sigma: float = 0):
        MAVLink_message.__init__(self, MAVLink_mag_field_message.id, MAVLink_mag_field_message.msgname)
        self._fieldnames = MAVLink_mag_field_message.fieldnames
        self._instance_field = MAVLink_mag_field_message.instance_field
        self._instance_offset = MAVLink_mag_field_message.instance_offset
        self.time_usec = time_usec
        self.total_field = total_field
        self.sequence = sequence
        self.calibration_id = calibration_id
        self.total_field_sigma = total_field_sigma
        self.x = x
        self.y = y
        self.z = z
        self.sigma_x = sigma_x
        self.sigma_y = sigma_y
        self.sigma_z = sigma_z
        self.anomaly = anomaly
        self.telemetry_age = telemetry_age
        self.latency = latency
        self.flags = flags
        self.sensor_id = sensor_id
        self.magnetic_heading = magnetic_heading
        self.heading = heading
        self.heading_sigma = heading_sigma

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.total_field, self.sequence, self.calibration_id, self.total_field_sigma, self.x, self.y, self.z, self.sigma_x, self.sigma_y, self.sigma_z, self.anomaly, self.telemetry_age, self.latency, self.flags, self.sensor_id, self.magnetic_heading, self.heading, self.heading_sigma), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_field_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_status_message(MAVLink_message):
    """
    State of the bridge. Counters run from its start.
    """

    id = MAVLINK_MSG_ID_MAG_STATUS
    msgname = "MAG_STATUS"
    fieldnames = ["time_usec", "vehicle_clock_offset", "uptime", "calibration_id", "samples", "samples_lost", "sensor_bytes_skipped", "sensor_frames_bad", "link_frames", "link_frames_lost", "link_bytes_skipped", "link_refused", "log_records", "log_lost", "telemetry_stale", "sample_rate", "sensor_clock_drift", "vehicle_clock_sigma", "vehicle_clock_drift", "vehicle_reboots", "sensor_state", "autopilot_state", "log_state"]
    ordered_fieldnames = ["time_usec", "vehicle_clock_offset", "uptime", "calibration_id", "samples", "samples_lost", "sensor_bytes_skipped", "sensor_frames_bad", "link_frames", "link_frames_lost", "link_bytes_skipped", "link_refused", "log_records", "log_lost", "telemetry_stale", "sample_rate", "sensor_clock_drift", "vehicle_clock_sigma", "vehicle_clock_drift", "vehicle_reboots", "sensor_state", "autopilot_state", "log_state"]
    fieldtypes = ["uint64_t", "int64_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "float", "float", "float", "float", "uint16_t", "uint8_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {"sensor_state": "MAG_PORT_STATE", "autopilot_state": "MAG_PORT_STATE", "log_state": "MAG_LOG_STATE"}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "vehicle_clock_offset": "us", "uptime": "s", "sensor_bytes_skipped": "bytes", "link_bytes_skipped": "bytes", "sample_rate": "Hz", "sensor_clock_drift": "ppm", "vehicle_clock_sigma": "s", "vehicle_clock_drift": "ppm"}
    native_format = bytearray(b"<QqIIIIIIIIIIIIIffffHBBB")
    orders = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    crc_extra = 66
    unpacker = struct.Struct("<QqIIIIIIIIIIIIIffffHBBB")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_usec: int, vehicle_clock_offset: int, uptime: int, calibration_id: int, samples: int, samples_lost: int, sensor_bytes_skipped: int, sensor_frames_bad: int, link_frames: int, link_frames_lost: int, link_bytes_skipped: int, link_refused: int, log_records: int, log_lost: int, telemetry_stale: int, sample_rate: float, sensor_clock_drift: float, vehicle_clock_sigma: float, vehicle_clock_drift: float, vehicle_reboots: int, sensor_state: int, autopilot_state: int, log_state: int):
        MAVLink_message.__init__(self, MAVLink_mag_status_message.id, MAVLink_mag_status_message.msgname)
        self._fieldnames = MAVLink_mag_status_message.fieldnames
        self._instance_field = MAVLink_mag_status_message.instance_field
        self._instance_offset = MAVLink_mag_status_message.instance_offset
        self.time_usec = time_usec
        self.vehicle_clock_offset = vehicle_clock_offset
        self.uptime = uptime
        self.calibration_id = calibration_id
        self.samples = samples
        self.samples_lost = samples_lost
        self.sensor_bytes_skipped = sensor_bytes_skipped
        self.sensor_frames_bad = sensor_frames_bad
        self.link_frames = link_frames
        self.link_frames_lost = link_frames_lost
        self.link_bytes_skipped = link_bytes_skipped
        self.link_refused = link_refused
        self.log_records = log_records
        self.log_lost = log_lost
        self.telemetry_stale = telemetry_stale
        self.sample_rate = sample_rate
        self.sensor_clock_drift = sensor_clock_drift
        self.vehicle_clock_sigma = vehicle_clock_sigma
        self.vehicle_clock_drift = vehicle_clock_drift
        self.vehicle_reboots = vehicle_reboots
        self.sensor_state = sensor_state
        self.autopilot_state = autopilot_state
        self.log_state = log_state

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.vehicle_clock_offset, self.uptime, self.calibration_id, self.samples, self.samples_lost, self.sensor_bytes_skipped, self.sensor_frames_bad, self.link_frames, self.link_frames_lost, self.link_bytes_skipped, self.link_refused, self.log_records, self.log_lost, self.telemetry_stale, self.sample_rate, self.sensor_clock_drift, self.vehicle_clock_sigma, self.vehicle_clock_drift, self.vehicle_reboots, self.sensor_state, self.autopilot_state, self.log_state), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_status_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_navigation_message(MAVLink_message):
    """
    One update of the position filter that compares the corrected
    field with an anomaly map.
    """

    id = MAVLINK_MSG_ID_MAG_NAVIGATION
    msgname = "MAG_NAVIGATION"
    fieldnames = ["time_usec", "lat", "lon", "covariance_nn", "covariance_ne", "covariance_ee", "innovation", "innovation_variance", "gate", "bias", "bias_sigma", "current_north", "current_east", "state", "accepted", "gps_state", "gps_reason"]
    ordered_fieldnames = ["time_usec", "lat", "lon", "covariance_nn", "covariance_ne", "covariance_ee", "innovation", "innovation_variance", "gate", "bias", "bias_sigma", "current_north", "current_east", "state", "accepted", "gps_state", "gps_reason"]
    fieldtypes = ["uint64_t", "int32_t", "int32_t", "float", "float", "float", "float", "float", "float", "float", "float", "float", "float", "uint8_t", "uint8_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {"state": "MAG_NAVIGATION_STATE", "gps_state": "MAG_GPS_STATE", "gps_reason": "MAG_GPS_REASON"}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "lat": "degE7", "lon": "degE7", "covariance_nn": "m^2", "covariance_ne": "m^2", "covariance_ee": "m^2", "innovation": "nT", "innovation_variance": "nT^2", "bias": "nT", "bias_sigma": "nT", "current_north": "m/s", "current_east": "m/s"}
    native_format = bytearray(b"<QiiffffffffffBBBB")
    orders = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    crc_extra = 3
    unpacker = struct.Struct("<QiiffffffffffBBBB")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_usec: int, lat: int, lon: int, covariance_nn: float, covariance_ne: float, covariance_ee: float, innovation: float, innovation_variance: float, gate: float, bias: float, bias_sigma: float, current_north: float, current_east: float, state: int, accepted: int, gps_state: int, gps_reason: int):
        MAVLink_message.__init__(self, MAVLink_mag_navigation_message.id, MAVLink_mag_navigation_message.msgname)
        self._fieldnames = MAVLink_mag_navigation_message.fieldnames
        self._instance_field = MAVLink_mag_navigation_message.instance_field
        self._instance_offset = MAVLink_mag_navigation_message.instance_offset
        self.time_usec = time_usec
        self.lat = lat
        self.lon = lon
        self.covariance_nn = covariance_nn
        self.covariance_ne = covariance_ne
        self.covariance_ee = covariance_ee
        self.innovation = innovation
        self.innovation_variance = innovation_variance
        self.gate = gate
        self.bias = bias
        self.bias_sigma = bias_sigma
        self.current_north = current_north
        self.current_east = current_east
        self.state = state
        self.accepted = accepted
        self.gps_state = gps_state
        self.gps_reason = gps_reason

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.lat, self.lon, self.covariance_nn, self.covariance_ne, self.covariance_ee, self.innovation, self.innovation_variance, self.gate, self.bias, self.bias_sigma, self.current_north, self.current_east, self.state, self.accepted, self.gps_state, self.gps_reason), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_navigation_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_sensor_bytes_message(MAVLink_message):
    """
    In logs only: bytes as they came from the sensor; the record's
    time stamp is their arrival.
    """

    id = MAVLINK_MSG_ID_MAG_SENSOR_BYTES
    msgname = "MAG_SENSOR_BYTES"
    fieldnames = ["sensor_id", "length", "data"]
    ordered_fieldnames = ["sensor_id", "length", "data"]
    fieldtypes = ["uint8_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"length": "bytes"}
    native_format = bytearray(b"<BBB")
    orders = [0, 1, 2]
    lengths = [1, 1, 253]
    array_lengths = [0, 0, 253]
    crc_extra = 5
    unpacker = struct.Struct("<BB253B")
    instance_field = "sensor_id"
    instance_offset = 0

    def __init__(self, sensor_id: int, length: int, data: Sequence[int]):
        MAVLink_message.__init__(self, MAVLink_mag_sensor_bytes_message.id, MAVLink_mag_sensor_bytes_message.msgname)
        self._fieldnames = MAVLink_mag_sensor_bytes_message.fieldnames
        self._instance_field = MAVLink_mag_sensor_bytes_message.instance_field
        self._instance_offset = MAVLink_mag_sensor_bytes_message.instance_offset
        self.sensor_id = sensor_id
        self.length = length
        self.data = data

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.sensor_id, self.length, self.data[0], self.data[1], self.data[2], self.data[3], self.data[4], self.data[5], self.data[6], self.data[7], self.data[8], self.data[9], self.data[10], self.data[11], self.data[12], self.data[13], self.data[14], self.data[15], self.data[16], self.data[17], self.data[18], self.data[19], self.data[20], self.data[21], self.data[22], self.data[23], self.data[24], self.data[25], self.data[26], self.data[27], self.data[28], self.data[29], self.data[30], self.data[31], self.data[32], self.data[33], self.data[34], self.data[35], self.data[36], self.data[37], self.data[38], self.data[39], self.data[40], self.data[41], self.data[42], self.data[43], self.data[44], self.data[45], self.data[46], self.data[47], self.data[48], self.data[49], self.data[50], self.data[51], self.data[52], self.data[53], self.data[54], self.data[55], self.data[56], self.data[57], self.data[58], self.data[59], self.data[60], self.data[61], self.data[62], self.data[63], self.data[64], self.data[65], self.data[66], self.data[67], self.data[68], self.data[69], self.data[70], self.data[71], self.data[72], self.data[73], self.data[74], self.data[75], self.data[76], self.data[77], self.data[78], self.data[79], self.data[80], self.data[81], self.data[82], self.data[83], self.data[84], self.data[85], self.data[86], self.data[87], self.data[88], self.data[89], self.data[90], self.data[91], self.data[92], self.data[93], self.data[94], self.data[95], self.data[96], self.data[97], self.data[98], self.data[99], self.data[100], self.data[101], self.data[102], self.data[103], self.data[104], self.data[105], self.data[106], self.data[107], self.data[108], self.data[109], self.data[110], self.data[111], self.data[112], self.data[113], self.data[114], self.data[115], self.data[116], self.data[117], self.data[118], self.data[119], self.data[120], self.data[121], self.data[122], self.data[123], self.data[124], self.data[125], self.data[126], self.data[127], self.data[128], self.data[129], self.data[130], self.data[131], self.data[132], self.data[133], self.data[134], self.data[135], self.data[136], self.data[137], self.data[138], self.data[139], self.data[140], self.data[141], self.data[142], self.data[143], self.data[144], self.data[145], self.data[146], self.data[147], self.data[148], self.data[149], self.data[150], self.data[151], self.data[152], self.data[153], self.data[154], self.data[155], self.data[156], self.data[157], self.data[158], self.data[159], self.data[160], self.data[161], self.data[162], self.data[163], self.data[164], self.data[165], self.data[166], self.data[167], self.data[168], self.data[169], self.data[170], self.data[171], self.data[172], self.data[173], self.data[174], self.data[175], self.data[176], self.data[177], self.data[178], self.data[179], self.data[180], self.data[181], self.data[182], self.data[183], self.data[184], self.data[185], self.data[186], self.data[187], self.data[188], self.data[189], self.data[190], self.data[191], self.data[192], self.data[193], self.data[194], self.data[195], self.data[196], self.data[197], self.data[198], self.data[199], self.data[200], self.data[201], self.data[202], self.data[203], self.data[204], self.data[205], self.data[206], self.data[207], self.data[208], self.data[209], self.data[210], self.data[211], self.data[212], self.data[213], self.data[214], self.data[215], self.data[216], self.data[217], self.data[218], self.data[219], self.data[220], self.data[221], self.data[222], self.data[223], self.data[224], self.data[225], self.data[226], self.data[227], self.data[228], self.data[229], self.data[230], self.data[231], self.data[232], self.data[233], self.data[234], self.data[235], self.data[236], self.data[237], self.data[238], self.data[239], self.data[240], self.data[241], self.data[242], self.data[243], self.data[244], self.data[245], self.data[246], self.data[247], self.data[248], self.data[249], self.data[250], self.data[251], self.data[252]), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_sensor_bytes_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_link_bytes_message(MAVLink_message):
    """
    In logs only: bytes from the link that belonged to no MAVLink
    frame, or not yet.
    """

    id = MAVLINK_MSG_ID_MAG_LINK_BYTES
    msgname = "MAG_LINK_BYTES"
    fieldnames = ["ahead", "length", "data"]
    ordered_fieldnames = ["ahead", "length", "data"]
    fieldtypes = ["uint8_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"length": "bytes"}
    native_format = bytearray(b"<BBB")
    orders = [0, 1, 2]
    lengths = [1, 1, 253]
    array_lengths = [0, 0, 253]
    crc_extra = 14
    unpacker = struct.Struct("<BB253B")
    instance_field = None
    instance_offset = -1

    def __init__(self, ahead: int, length: int, data: Sequence[int]):
        MAVLink_message.__init__(self, MAVLink_mag_link_bytes_message.id, MAVLink_mag_link_bytes_message.msgname)
        self._fieldnames = MAVLink_mag_link_bytes_message.fieldnames
        self._instance_field = MAVLink_mag_link_bytes_message.instance_field
        self._instance_offset = MAVLink_mag_link_bytes_message.instance_offset
        self.ahead = ahead
        self.length = length
        self.data = data

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.ahead, self.length, self.data[0], self.data[1], self.data[2], self.data[3], self.data[4], self.data[5], self.data[6], self.data[7], self.data[8], self.data[9], self.data[10], self.data[11], self.data[12], self.data[13], self.data[14], self.data[15], self.data[16], self.data[17], self.data[18], self.data[19], self.data[20], self.data[21], self.data[22], self.data[23], self.data[24], self.data[25], self.data[26], self.data[27], self.data[28], self.data[29], self.data[30], self.data[31], self.data[32], self.data[33], self.data[34], self.data[35], self.data[36], self.data[37], self.data[38], self.data[39], self.data[40], self.data[41], self.data[42], self.data[43], self.data[44], self.data[45], self.data[46], self.data[47], self.data[48], self.data[49], self.data[50], self.data[51], self.data[52], self.data[53], self.data[54], self.data[55], self.data[56], self.data[57], self.data[58], self.data[59], self.data[60], self.data[61], self.data[62], self.data[63], self.data[64], self.data[65], self.data[66], self.data[67], self.data[68], self.data[69], self.data[70], self.data[71], self.data[72], self.data[73], self.data[74], self.data[75], self.data[76], self.data[77], self.data[78], self.data[79], self.data[80], self.data[81], self.data[82], self.data[83], self.data[84], self.data[85], self.data[86], self.data[87], self.data[88], self.data[89], self.data[90], self.data[91], self.data[92], self.data[93], self.data[94], self.data[95], self.data[96], self.data[97], self.data[98], self.data[99], self.data[100], self.data[101], self.data[102], self.data[103], self.data[104], self.data[105], self.data[106], self.data[107], self.data[108], self.data[109], self.data[110], self.data[111], self.data[112], self.data[113], self.data[114], self.data[115], self.data[116], self.data[117], self.data[118], self.data[119], self.data[120], self.data[121], self.data[122], self.data[123], self.data[124], self.data[125], self.data[126], self.data[127], self.data[128], self.data[129], self.data[130], self.data[131], self.data[132], self.data[133], self.data[134], self.data[135], self.data[136], self.data[137], self.data[138], self.data[139], self.data[140], self.data[141], self.data[142], self.data[143], self.data[144], self.data[145], self.data[146], self.data[147], self.data[148], self.data[149], self.data[150], self.data[151], self.data[152], self.data[153], self.data[154], self.data[155], self.data[156], self.data[157], self.data[158], self.data[159], self.data[160], self.data[161], self.data[162], self.data[163], self.data[164], self.data[165], self.data[166], self.data[167], self.data[168], self.data[169], self.data[170], self.data[171], self.data[172], self.data[173], self.data[174], self.data[175], self.data[176], self.data[177], self.data[178], self.data[179], self.data[180], self.data[181], self.data[182], self.data[183], self.data[184], self.data[185], self.data[186], self.data[187], self.data[188], self.data[189], self.data[190], self.data[191], self.data[192], self.data[193], self.data[194], self.data[195], self.data[196], self.data[197], self.data[198], self.data[199], self.data[200], self.data[201], self.data[202], self.data[203], self.data[204], self.data[205], self.data[206], self.data[207], self.data[208], self.data[209], self.data[210], self.data[211], self.data[212], self.data[213], self.data[214], self.data[215], self.data[216], self.data[217], self.data[218], self.data[219], self.data[220], self.data[221], self.data[222], self.data[223], self.data[224], self.data[225], self.data[226], self.data[227], self.data[228], self.data[229], self.data[230], self.data[231], self.data[232], self.data[233], self.data[234], self.data[235], self.data[236], self.data[237], self.data[238], self.data[239], self.data[240], self.data[241], self.data[242], self.data[243], self.data[244], self.data[245], self.data[246], self.data[247], self.data[248], self.data[249], self.data[250], self.data[251], self.data[252]), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_link_bytes_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_bridge_start_message(MAVLink_message):
    """
    In logs: the bridge started. What a replay needs to know, with the
    PARAM_VALUE records that follow.
    """

    id = MAVLINK_MSG_ID_MAG_BRIDGE_START
    msgname = "MAG_BRIDGE_START"
    fieldnames = ["time_usec", "signing_timestamp", "calibration_id", "config_digest", "version", "driver"]
    ordered_fieldnames = ["time_usec", "signing_timestamp", "calibration_id", "config_digest", "version", "driver"]
    fieldtypes = ["uint64_t", "uint64_t", "uint32_t", "uint8_t", "char", "char"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us"}
    native_format = bytearray(b"<QQIBcc")
    orders = [0, 1, 2, 3, 4, 5]
    lengths = [1, 1, 1, 8, 1, 1]
    array_lengths = [0, 0, 0, 8, 24, 24]
    crc_extra = 172
    unpacker = struct.Struct("<QQI8B24s24s")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_usec: int, signing_timestamp: int, calibration_id: int, config_digest: Sequence[int], version: bytes, driver: bytes):
        MAVLink_message.__init__(self, MAVLink_mag_bridge_start_message.id, MAVLink_mag_bridge_start_message.msgname)
        self._fieldnames = MAVLink_mag_bridge_start_message.fieldnames
        self._instance_field = MAVLink_mag_bridge_start_message.instance_field
        self._instance_offset = MAVLink_mag_bridge_start_message.instance_offset
        self.time_usec = time_usec
        self.signing_timestamp = signing_timestamp
        self.calibration_id = calibration_id
        self.config_digest = config_digest
        self._version_raw = version
        self.version = version.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._driver_raw = driver
        self.driver = driver.split(b"\x00", 1)[0].decode("ascii", errors="replace")

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.signing_timestamp, self.calibration_id, self.config_digest[0], self.config_digest[1], self.config_digest[2], self.config_digest[3], self.config_digest[4], self.config_digest[5], self.config_digest[6], self.config_digest[7], self._version_raw, self._driver_raw), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_bridge_start_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_clock_step_message(MAVLink_message):
    """
    The bridge's clock was set; times before this message belong to
    the old setting.
    """

    id = MAVLINK_MSG_ID_MAG_CLOCK_STEP
    msgname = "MAG_CLOCK_STEP"
    fieldnames = ["time_usec", "step"]
    ordered_fieldnames = ["time_usec", "step"]
    fieldtypes = ["uint64_t", "int64_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "step": "us"}
    native_format = bytearray(b"<Qq")
    orders = [0, 1]
    lengths = [1, 1]
    array_lengths = [0, 0]
    crc_extra = 81
    unpacker = struct.Struct("<Qq")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_usec: int, step: int):
        MAVLink_message.__init__(self, MAVLink_mag_clock_step_message.id, MAVLink_mag_clock_step_message.msgname)
        self._fieldnames = MAVLink_mag_clock_step_message.fieldnames
        self._instance_field = MAVLink_mag_clock_step_message.instance_field
        self._instance_offset = MAVLink_mag_clock_step_message.instance_offset
        self.time_usec = time_usec
        self.step = step

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.step), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_clock_step_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_port_message(MAVLink_message):
    """
    In logs: a port of the bridge opened, was lost, or could not be
    opened.
    """

    id = MAVLINK_MSG_ID_MAG_PORT
    msgname = "MAG_PORT"
    fieldnames = ["time_usec", "dropped", "port", "state", "reason"]
    ordered_fieldnames = ["time_usec", "dropped", "port", "state", "reason"]
    fieldtypes = ["uint64_t", "uint32_t", "uint8_t", "uint8_t", "char"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {"port": "MAG_PORT_NAME", "state": "MAG_PORT_STATE"}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "dropped": "bytes"}
    native_format = bytearray(b"<QIBBc")
    orders = [0, 1, 2, 3, 4]
    lengths = [1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 80]
    crc_extra = 171
    unpacker = struct.Struct("<QIBB80s")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_usec: int, dropped: int, port: int, state: int, reason: bytes):
        MAVLink_message.__init__(self, MAVLink_mag_port_message.id, MAVLink_mag_port_message.msgname)
        self._fieldnames = MAVLink_mag_port_message.fieldnames
        self._instance_field = MAVLink_mag_port_message.instance_field
        self._instance_offset = MAVLink_mag_port_message.instance_offset
        self.time_usec = time_usec
        self.dropped = dropped
        self.port = port
        self.state = state
        self._reason_raw = reason
        self.reason = reason.split(b"\x00", 1)[0].decode("ascii", errors="replace")

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.dropped, self.port, self.state, self._reason_raw), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_port_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_column_message(MAVLink_message):
    """
    In logs only: the field of a message that is a column of the log,
    scale * field + offset. Without a message: an attribute of the
    whole log, its name in column, its value in unit or, if it is a
    number, in scale.
    """

    id = MAVLINK_MSG_ID_MAG_COLUMN
    msgname = "MAG_COLUMN"
    fieldnames = ["scale", "offset", "unit", "message", "field", "match", "column", "component"]
    ordered_fieldnames = ["scale", "offset", "unit", "message", "field", "match", "column", "component"]
    fieldtypes = ["double", "double", "char", "char", "char", "char", "char", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {}
    native_format = bytearray(b"<ddcccccB")
    orders = [0, 1, 2, 3, 4, 5, 6, 7]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 16, 44, 40, 64, 64, 0]
    crc_extra = 112
    unpacker = struct.Struct("<dd16s44s40s64s64sB")
    instance_field = None
    instance_offset = -1

    def __init__(self, scale: float, offset: float, unit: bytes, message: bytes, field: bytes, match: bytes, column: bytes, component: int = 0):
        MAVLink_message.__init__(self, MAVLink_mag_column_message.id, MAVLink_mag_column_message.msgname)
        self._fieldnames = MAVLink_mag_column_message.fieldnames
        self._instance_field = MAVLink_mag_column_message.instance_field
        self._instance_offset = MAVLink_mag_column_message.instance_offset
        self.scale = scale
        self.offset = offset
        self._unit_raw = unit
        self.unit = unit.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._message_raw = message
        self.message = message.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._field_raw = field
        self.field = field.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._match_raw = match
        self.match = match.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._column_raw = column
        self.column = column.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self.component = component

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.scale, self.offset, self._unit_raw, self._message_raw, self._field_raw, self._match_raw, self._column_raw, self.component), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_column_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_host_stall_message(MAVLink_message):
    """
    In logs only: the bridge stood still; inputs of that time waited.
    """

    id = MAVLINK_MSG_ID_MAG_HOST_STALL
    msgname = "MAG_HOST_STALL"
    fieldnames = ["time_usec", "duration"]
    ordered_fieldnames = ["time_usec", "duration"]
    fieldtypes = ["uint64_t", "uint32_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "duration": "us"}
    native_format = bytearray(b"<QI")
    orders = [0, 1]
    lengths = [1, 1]
    array_lengths = [0, 0]
    crc_extra = 158
    unpacker = struct.Struct("<QI")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_usec: int, duration: int):
        MAVLink_message.__init__(self, MAVLink_mag_host_stall_message.id, MAVLink_mag_host_stall_message.msgname)
        self._fieldnames = MAVLink_mag_host_stall_message.fieldnames
        self._instance_field = MAVLink_mag_host_stall_message.instance_field
        self._instance_offset = MAVLink_mag_host_stall_message.instance_offset
        self.time_usec = time_usec
        self.duration = duration

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.duration), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_host_stall_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_learning_message(MAVLink_message):
    """
    State of the in-flight calibration, and whether it explains the
    data.
    """

    id = MAVLINK_MSG_ID_MAG_LEARNING
    msgname = "MAG_LEARNING"
    fieldnames = ["time_usec", "alarm_since", "calibration_id", "first_calibration_id", "samples", "rms_first", "rms_published", "rms_learned", "better", "alarm_amplitude", "causes", "state", "sensor_id"]
    ordered_fieldnames = ["time_usec", "alarm_since", "calibration_id", "first_calibration_id", "samples", "rms_first", "rms_published", "rms_learned", "better", "alarm_amplitude", "causes", "state", "sensor_id"]
    fieldtypes = ["uint64_t", "uint64_t", "uint32_t", "uint32_t", "uint32_t", "float", "float", "float", "float", "float", "uint16_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {"causes": "bitmask"}
    fieldenums_by_name: Dict[str, str] = {"causes": "MAG_CAUSE", "state": "MAG_LEARNING_STATE"}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "alarm_since": "us", "rms_first": "nT", "rms_published": "nT", "rms_learned": "nT", "alarm_amplitude": "nT"}
    native_format = bytearray(b"<QQIIIfffffHBB")
    orders = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    crc_extra = 157
    unpacker = struct.Struct("<QQIIIfffffHBB")
    instance_field = "sensor_id"
    instance_offset = 51

    def __init__(self, time_usec: int, alarm_since: int, calibration_id: int, first_calibration_id: int, samples: int, rms_first: float, rms_published: float, rms_learned: float, better: float, alarm_amplitude: float, causes: int, state: int, sensor_id: int):
        MAVLink_message.__init__(self, MAVLink_mag_learning_message.id, MAVLink_mag_learning_message.msgname)
        self._fieldnames = MAVLink_mag_learning_message.fieldnames
        self._instance_field = MAVLink_mag_learning_message.instance_field
        self._instance_offset = MAVLink_mag_learning_message.instance_offset
        self.time_usec = time_usec
        self.alarm_since = alarm_since
        self.calibration_id = calibration_id
        self.first_calibration_id = first_calibration_id
        self.samples = samples
        self.rms_first = rms_first
        self.rms_published = rms_published
        self.rms_learned = rms_learned
        self.better = better
        self.alarm_amplitude = alarm_amplitude
        self.causes = causes
        self.state = state
        self.sensor_id = sensor_id

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.alarm_since, self.calibration_id, self.first_calibration_id, self.samples, self.rms_first, self.rms_published, self.rms_learned, self.better, self.alarm_amplitude, self.causes, self.state, self.sensor_id), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_learning_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_sensor_message(MAVLink_message):
    """
    State of one sensor of a bridge that has several; sent with
    MAG_STATUS. Counters run from the start of the bridge.
    """

    id = MAVLINK_MSG_ID_MAG_SENSOR
    msgname = "MAG_SENSOR"
    fieldnames = ["time_usec", "calibration_id", "samples", "samples_lost", "bytes_skipped", "frames_bad", "sample_rate", "clock_drift", "sensor_id", "state", "name"]
    ordered_fieldnames = ["time_usec", "calibration_id", "samples", "samples_lost", "bytes_skipped", "frames_bad", "sample_rate", "clock_drift", "sensor_id", "state", "name"]
    fieldtypes = ["uint64_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "uint32_t", "float", "float", "uint8_t", "uint8_t", "char"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {"state": "MAG_PORT_STATE"}
    fieldunits_by_name: Dict[str, str] = {"time_usec": "us", "bytes_skipped": "bytes", "sample_rate": "Hz", "clock_drift": "ppm"}
    native_format = bytearray(b"<QIIIIIffBBc")
    orders = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 16]
    crc_extra = 169
    unpacker = struct.Struct("<QIIIIIffBB16s")
    instance_field = "sensor_id"
    instance_offset = 36

    def __init__(self, time_usec: int, calibration_id: int, samples: int, samples_lost: int, bytes_skipped: int, frames_bad: int, sample_rate: float, clock_drift: float, sensor_id: int, state: int, name: bytes):
        MAVLink_message.__init__(self, MAVLink_mag_sensor_message.id, MAVLink_mag_sensor_message.msgname)
        self._fieldnames = MAVLink_mag_sensor_message.fieldnames
        self._instance_field = MAVLink_mag_sensor_message.instance_field
        self._instance_offset = MAVLink_mag_sensor_message.instance_offset
        self.time_usec = time_usec
        self.calibration_id = calibration_id
        self.samples = samples
        self.samples_lost = samples_lost
        self.bytes_skipped = bytes_skipped
        self.frames_bad = frames_bad
        self.sample_rate = sample_rate
        self.clock_drift = clock_drift
        self.sensor_id = sensor_id
        self.state = state
        self._name_raw = name
        self.name = name.split(b"\x00", 1)[0].decode("ascii", errors="replace")

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_usec, self.calibration_id, self.samples, self.samples_lost, self.bytes_skipped, self.frames_bad, self.sample_rate, self.clock_drift, self.sensor_id, self.state, self._name_raw), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_sensor_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_signing_stream_message(MAVLink_message):
    """
    In logs: the last time stamp accepted of one signed stream when
    the bridge started; after MAG_BRIDGE_START.
    """

    id = MAVLINK_MSG_ID_MAG_SIGNING_STREAM
    msgname = "MAG_SIGNING_STREAM"
    fieldnames = ["stamp", "link", "system", "sender", "ahead"]
    ordered_fieldnames = ["stamp", "link", "system", "sender", "ahead"]
    fieldtypes = ["uint64_t", "uint8_t", "uint8_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {}
    native_format = bytearray(b"<QBBBB")
    orders = [0, 1, 2, 3, 4]
    lengths = [1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0, 0]
    crc_extra = 216
    unpacker = struct.Struct("<QBBBB")
    instance_field = None
    instance_offset = -1

    def __init__(self, stamp: int, link: int, system: int, sender: int, ahead: int):
        MAVLink_message.__init__(self, MAVLink_mag_signing_stream_message.id, MAVLink_mag_signing_stream_message.msgname)
        self._fieldnames = MAVLink_mag_signing_stream_message.fieldnames
        self._instance_field = MAVLink_mag_signing_stream_message.instance_field
        self._instance_offset = MAVLink_mag_signing_stream_message.instance_offset
        self.stamp = stamp
        self.link = link
        self.system = system
        self.sender = sender
        self.ahead = ahead

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.stamp, self.link, self.system, self.sender, self.ahead), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_signing_stream_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_mag_interleaved_message(MAVLink_message):
    """
    In logs only: that frames of a file were sent, which are not in
    the log; a replay needs their number.
    """

    id = MAVLINK_MSG_ID_MAG_INTERLEAVED
    msgname = "MAG_INTERLEAVED"
    fieldnames = ["count"]
    ordered_fieldnames = ["count"]
    fieldtypes = ["uint16_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {}
    native_format = bytearray(b"<H")
    orders = [0]
    lengths = [1]
    array_lengths = [0]
    crc_extra = 127
    unpacker = struct.Struct("<H")
    instance_field = None
    instance_offset = -1

    def __init__(self, count: int):
        MAVLink_message.__init__(self, MAVLink_mag_interleaved_message.id, MAVLink_mag_interleaved_message.msgname)
        self._fieldnames = MAVLink_mag_interleaved_message.fieldnames
        self._instance_field = MAVLink_mag_interleaved_message.instance_field
        self._instance_offset = MAVLink_mag_interleaved_message.instance_offset
        self.count = count

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.count), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_mag_interleaved_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_component_information_basic_message(MAVLink_message):
    """
    Basic component information data; to be requested.
    """

    id = MAVLINK_MSG_ID_COMPONENT_INFORMATION_BASIC
    msgname = "COMPONENT_INFORMATION_BASIC"
    fieldnames = ["time_boot_ms", "capabilities", "time_manufacture_s", "vendor_name", "model_name", "software_version", "hardware_version", "serial_number"]
    ordered_fieldnames = ["capabilities", "time_boot_ms", "time_manufacture_s", "vendor_name", "model_name", "software_version", "hardware_version", "serial_number"]
    fieldtypes = ["uint32_t", "uint64_t", "uint32_t", "char", "char", "char", "char", "char"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"time_boot_ms": "ms", "time_manufacture_s": "s"}
    native_format = bytearray(b"<QIIccccc")
    orders = [1, 0, 2, 3, 4, 5, 6, 7]
    lengths = [1, 1, 1, 1, 1, 1, 1, 1]
    array_lengths = [0, 0, 0, 32, 32, 24, 24, 32]
    crc_extra = 50
    unpacker = struct.Struct("<QII32s32s24s24s32s")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_boot_ms: int, capabilities: int, time_manufacture_s: int, vendor_name: bytes, model_name: bytes, software_version: bytes, hardware_version: bytes, serial_number: bytes):
        MAVLink_message.__init__(self, MAVLink_component_information_basic_message.id, MAVLink_component_information_basic_message.msgname)
        self._fieldnames = MAVLink_component_information_basic_message.fieldnames
        self._instance_field = MAVLink_component_information_basic_message.instance_field
        self._instance_offset = MAVLink_component_information_basic_message.instance_offset
        self.time_boot_ms = time_boot_ms
        self.capabilities = capabilities
        self.time_manufacture_s = time_manufacture_s
        self._vendor_name_raw = vendor_name
        self.vendor_name = vendor_name.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._model_name_raw = model_name
        self.model_name = model_name.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._software_version_raw = software_version
        self.software_version = software_version.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._hardware_version_raw = hardware_version
        self.hardware_version = hardware_version.split(b"\x00", 1)[0].decode("ascii", errors="replace")
        self._serial_number_raw = serial_number
        self.serial_number = serial_number.split(b"\x00", 1)[0].decode("ascii", errors="replace")

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.capabilities, self.time_boot_ms, self.time_manufacture_s, self._vendor_name_raw, self._model_name_raw, self._software_version_raw, self._hardware_version_raw, self._serial_number_raw), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_component_information_basic_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_component_metadata_message(MAVLink_message):
    """
    Where the general metadata file is, which names the others.
    """

    id = MAVLINK_MSG_ID_COMPONENT_METADATA
    msgname = "COMPONENT_METADATA"
    fieldnames = ["time_boot_ms", "file_crc", "uri"]
    ordered_fieldnames = ["time_boot_ms", "file_crc", "uri"]
    fieldtypes = ["uint32_t", "uint32_t", "char"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"time_boot_ms": "ms"}
    native_format = bytearray(b"<IIc")
    orders = [0, 1, 2]
    lengths = [1, 1, 1]
    array_lengths = [0, 0, 100]
    crc_extra = 182
    unpacker = struct.Struct("<II100s")
    instance_field = None
    instance_offset = -1

    def __init__(self, time_boot_ms: int, file_crc: int, uri: bytes):
        MAVLink_message.__init__(self, MAVLink_component_metadata_message.id, MAVLink_component_metadata_message.msgname)
        self._fieldnames = MAVLink_component_metadata_message.fieldnames
        self._instance_field = MAVLink_component_metadata_message.instance_field
        self._instance_offset = MAVLink_component_metadata_message.instance_offset
        self.time_boot_ms = time_boot_ms
        self.file_crc = file_crc
        self._uri_raw = uri
        self.uri = uri.split(b"\x00", 1)[0].decode("ascii", errors="replace")

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.time_boot_ms, self.file_crc, self._uri_raw), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_component_metadata_message, "name", mavlink_msg_deprecated_name_property())


class MAVLink_timesync_message(MAVLink_message):
    """
    Time synchronization, with the address.
    """

    id = MAVLINK_MSG_ID_TIMESYNC
    msgname = "TIMESYNC"
    fieldnames = ["tc1", "ts1", "target_system", "target_component"]
    ordered_fieldnames = ["tc1", "ts1", "target_system", "target_component"]
    fieldtypes = ["int64_t", "int64_t", "uint8_t", "uint8_t"]
    fielddisplays_by_name: Dict[str, str] = {}
    fieldenums_by_name: Dict[str, str] = {}
    fieldunits_by_name: Dict[str, str] = {"tc1": "ns", "ts1": "ns"}
    native_format = bytearray(b"<qqBB")
    orders = [0, 1, 2, 3]
    lengths = [1, 1, 1, 1]
    array_lengths = [0, 0, 0, 0]
    crc_extra = 34
    unpacker = struct.Struct("<qqBB")
    instance_field = None
    instance_offset = -1

    def __init__(self, tc1: int, ts1: int, target_system: int = 0, target_component: int = 0):
        MAVLink_message.__init__(self, MAVLink_timesync_message.id, MAVLink_timesync_message.msgname)
        self._fieldnames = MAVLink_timesync_message.fieldnames
        self._instance_field = MAVLink_timesync_message.instance_field
        self._instance_offset = MAVLink_timesync_message.instance_offset
        self.tc1 = tc1
        self.ts1 = ts1
        self.target_system = target_system
        self.target_component = target_component

    def pack(self, mav: "MAVLink", force_mavlink1: bool = False) -> bytes:
        return self._pack(mav, self.crc_extra, self.unpacker.pack(self.tc1, self.ts1, self.target_system, self.target_component), force_mavlink1=force_mavlink1)


# Define name on the class for backwards compatibility (it is now msgname).
# Done with setattr to hide the class variable from mypy.
setattr(MAVLink_timesync_message, "name", mavlink_msg_deprecated_name_property())


mavlink_map: Dict[int, Type[MAVLink_message]] = {
    MAVLINK_MSG_ID_MAG_RAW: MAVLink_mag_raw_message,
    MAVLINK_MSG_ID_MAG_FIELD: MAVLink_mag_field_message,
    MAVLINK_MSG_ID_MAG_STATUS: MAVLink_mag_status_message,
    MAVLINK_MSG_ID_MAG_NAVIGATION: MAVLink_mag_navigation_message,
    MAVLINK_MSG_ID_MAG_SENSOR_BYTES: MAVLink_mag_sensor_bytes_message,
    MAVLINK_MSG_ID_MAG_LINK_BYTES: MAVLink_mag_link_bytes_message,
    MAVLINK_MSG_ID_MAG_BRIDGE_START: MAVLink_mag_bridge_start_message,
    MAVLINK_MSG_ID_MAG_CLOCK_STEP: MAVLink_mag_clock_step_message,
    MAVLINK_MSG_ID_MAG_PORT: MAVLink_mag_port_message,
    MAVLINK_MSG_ID_MAG_COLUMN: MAVLink_mag_column_message,
    MAVLINK_MSG_ID_MAG_HOST_STALL: MAVLink_mag_host_stall_message,
    MAVLINK_MSG_ID_MAG_LEARNING: MAVLink_mag_learning_message,
    MAVLINK_MSG_ID_MAG_SENSOR: MAVLink_mag_sensor_message,
    MAVLINK_MSG_ID_MAG_SIGNING_STREAM: MAVLink_mag_signing_stream_message,
    MAVLINK_MSG_ID_MAG_INTERLEAVED: MAVLink_mag_interleaved_message,
    MAVLINK_MSG_ID_COMPONENT_INFORMATION_BASIC: MAVLink_component_information_basic_message,
    MAVLINK_MSG_ID_COMPONENT_METADATA: MAVLink_component_metadata_message,
    MAVLINK_MSG_ID_TIMESYNC: MAVLink_timesync_message,
}

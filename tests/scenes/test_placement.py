import math
from pathlib import Path

import pytest

from scenes.placement import Placement, Waypoint, parse_at, parse_placement, read_waypoints


def test_a_place_is_metres_forward_and_left():
    assert parse_at("20m,-350cm") == (20, -3.5)


def test_a_placement_says_asset_place_heading_and_speed():
    assert parse_placement("car/0003@12m,3.5m") == Placement("car/0003", 12, 3.5)
    full = parse_placement("car/0003@12m,-3.5m,yaw=180deg,speed=36km/h")
    assert full == Placement("car/0003", 12, -3.5, math.pi, 10)
    assert parse_placement("car/0003@trajectory=a/t.csv") == Placement("car/0003", trajectory=Path("a/t.csv"))
    assert parse_placement("car/0003@trajectory=run,2@b=1.csv") == Placement("car/0003", trajectory=Path("run,2@b=1.csv"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("car/0003", "write ID@X,Y"),
        ("@1m,2m", "write ID@X,Y"),
        ("car/0003@12,3.5m", '"12" has no unit; write 12m'),
        ("car/0003@12m", "metres forward and left"),
        ("car/0003@12m,3m,yaw=5", '"5" has no unit; write 5deg'),
        ("car/0003@12m,3m,yow=5deg", "Did you mean yaw?"),
        ("car/0003@12m,3m,speed=5m", "a length, not a speed"),
        ("car/0003@1m,2m,trajectory=t.csv", "leave out the place"),
        ("car/0003@12m,3m,yaw=5deg,yaw=6deg", "says yaw twice; say it once"),
        ("car/0003@1e30m,0m", "car/0003 at 1e+30m,0m is more than 100 km from the car at the clip's first frame"),
        ("car/0003@0m,-101km", "a place counts metres from there, not coordinates of a map"),
        ("car/0003@12m,3m,speed=1e9m/s", "car/0003 at 1e+09m/s is faster than 150m/s, as nothing on a road is; write km/h as 50km/h"),
    ],
)
def test_a_wrong_placement_names_the_fix(text, says):
    with pytest.raises(ValueError) as error:
        parse_placement(text)
    assert says in str(error.value)


def test_waypoints_come_from_csv(tmp_path):
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m,yaw_deg\n0,10,-3.5,0\n\n 1.5, 20, -3.5, 90\n")
    assert read_waypoints(tmp_path / "t.csv") == [Waypoint(0, 10, -3.5, 0), Waypoint(1_500_000, 20, -3.5, math.pi / 2)]


def test_yaw_is_optional(tmp_path):
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m\n0,10,-3.5\n1,20,-3.5\n")
    assert [p.yaw for p in read_waypoints(tmp_path / "t.csv")] == [None, None]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "must begin with the header"),
        ("t,x,y\n0,1,2\n", 'got "t,x,y"'),
        ("time_s,x_m,y_m\n0,1,2\n", "1 row below its header; a trajectory needs at least 2; what stands has its place in both"),
        ("time_s;x_m;y_m\n0;1,5;2\n1;2,5;2\n", "by commas, not by semicolons, and write decimals with a point"),
        ("time_s\tx_m\ty_m\n0\t1\t2\n", "by commas, not by tabs"),
        ("time_s,x_m,y_m\n0,1,2\n1,2\n", "line 3: 2 values for 3 columns"),
        ("time_s,x_m,y_m\n0,1,2\n1,far,2\n", 'line 3: x_m is "far"'),
        ("time_s,x_m,y_m\n0,1,2\n1,nan,2\n", "line 3: x_m"),
        ("time_s,x_m,y_m\n0,1,2\n1\n", "line 3: 1 value for 3 columns"),
        ("time_s,x_m,y_m\n1,1,2\n1,2,2\n", "line 3: time_s must rise"),
        ("time_s,x_m,y_m\n0,1,2\n0.0000001,2,2\n", "line 3: time_s must rise by a microsecond or more, but 0.0000001 follows 0"),
    ],
)
def test_a_wrong_csv_names_line_and_fix(tmp_path, text, says):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(ValueError) as error:
        read_waypoints(tmp_path / "t.csv")
    assert says in str(error.value)
    assert "t.csv" in str(error.value)


def test_quotes_as_r_and_pandas_write_them_are_read(tmp_path):
    (tmp_path / "t.csv").write_text('"time_s","x_m","y_m"\n"0","10",3\n1,15,3\n')
    assert read_waypoints(tmp_path / "t.csv") == [Waypoint(0, 10, 3, None), Waypoint(1_000_000, 15, 3, None)]


def test_a_binary_file_is_no_csv(tmp_path):
    (tmp_path / "t.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(ValueError, match="not a text file in UTF-8; save it as that"):
        read_waypoints(tmp_path / "t.csv")

#!/usr/bin/env python3
"""A ROS 2 node that sends what servoscope's outlet `ros2` keeps: diagnostics every second, faults until accepted.

python3 servoscope_bridge.py --ros-args -p file:=ros2/ros2.json
"""

import json
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

try:
    from ros2_medkit_msgs.srv import ReportFault
except ImportError:  # without ros2_medkit: diagnostics alone
    ReportFault = None


class Bridge(Node):
    """Reads the file once a second."""

    def __init__(self):
        super().__init__("servoscope_bridge")
        self.file, self.accepted = Path(self.declare_parameter("file", "ros2.json").value), {}
        self.publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.manager = self.create_client(ReportFault, "/fault_manager/report_fault") if ReportFault else None
        self.create_timer(1.0, self.send)

    def send(self):
        """Send all diagnostics, and the reports that the fault manager has not yet accepted as they are."""
        try:
            document = json.loads(self.file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            return self.get_logger().warning(f"{self.file}: {error}")
        stale = {"level": 3, "message": "servoscope does not run"} if time.time() > document["until"] else {}
        array = DiagnosticArray(status=[filled(DiagnosticStatus(), one | stale) for one in document["status"]])
        array.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(array)
        if self.manager is not None and self.manager.service_is_ready():
            for report in document["reports"]:
                if self.accepted.get(report["fault_code"]) != report:
                    reply = self.manager.call_async(filled(ReportFault.Request(), report))
                    reply.add_done_callback(lambda reply, report=report: self.note(reply.result(), report))

    def note(self, answer, report):
        """Keep what has been accepted."""
        if answer.accepted:
            self.accepted[report["fault_code"]] = report


def filled(message, fields):
    """Return a message with the fields of a document."""
    for name, value in fields.items():
        if name in ("values", "evidence"):
            value = [KeyValue(**pair) for pair in value]
        if hasattr(message, name):  # `evidence` came later than the rest
            setattr(message, name, bytes([value]) if name == "level" else value)
    return message


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Bridge())

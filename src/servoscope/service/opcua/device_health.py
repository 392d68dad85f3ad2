"""Health and alarm types of the OPC UA companion specification for devices (DI, OPC 10000-100), as far as used.

The numbers are those of its published nodeset; the library comes without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servoscope.service.opcua.settings import import_ua

URI = "http://opcfoundation.org/UA/DI/"
HEALTH = ("NORMAL", "FAILURE", "CHECK_FUNCTION", "OFF_SPEC", "MAINTENANCE_REQUIRED")  # by value
HEALTH_OF_NE107: Mapping[str, int] = {
    "good": 0, "failure": 1, "function_check": 2, "out_of_specification": 3, "maintenance_required": 4,
}  # fmt: skip
ENUMERATION, STRINGS, INTERFACE, INTERFACE_HEALTH, ABSTRACT_ALARM = 6244, 6450, 15051, 15052, 15143
ALARM_TYPES: Mapping[str, tuple[int, str]] = {  # of an alarm, by the NE 107 status that it gives to its asset
    "failure": (15292, "FailureAlarmType"),
    "function_check": (15441, "CheckFunctionAlarmType"),
    "out_of_specification": (15590, "OffSpecAlarmType"),
    "maintenance_required": (15739, "MaintenanceRequiredAlarmType"),
}


async def add_types(server: Any) -> tuple[int, dict[str, Any]]:
    """Add the types to a server; return the index of their namespace, and the type of an alarm by its NE 107 status.

    That of an alarm without one is under "".
    """
    ua = import_ua()
    index = await server.register_namespace(URI)

    def node(number: int) -> Any:
        return ua.NodeId(number, index)

    enumeration = await server.get_node(ua.ObjectIds.Enumeration).add_data_type(
        node(ENUMERATION), f"{index}:DeviceHealthEnumeration"
    )
    names = [ua.LocalizedText(name) for name in HEALTH]
    await enumeration.add_property(node(STRINGS), "0:EnumStrings", names)
    fields = [ua.EnumField(Name=name, Value=value) for value, name in enumerate(HEALTH)]
    definition = ua.DataValue(ua.Variant(ua.EnumDefinition(Fields=fields), ua.VariantType.ExtensionObject))
    await enumeration.write_attribute(ua.AttributeIds.DataTypeDefinition, definition)
    base = server.get_node(ua.ObjectIds.BaseInterfaceType)
    interface = await base.add_object_type(node(INTERFACE), f"{index}:IDeviceHealthType")
    await add_health(interface, index, node(INTERFACE_HEALTH))
    parent = server.get_node(ua.ObjectIds.InstrumentDiagnosticAlarmType)
    abstract = await parent.add_object_type(node(ABSTRACT_ALARM), f"{index}:DeviceHealthDiagnosticAlarmType")
    for abstract_type in (interface, abstract):
        await abstract_type.write_attribute(ua.AttributeIds.IsAbstract, ua.DataValue(True))
    types = {"": ua.NodeId(ua.ObjectIds.SystemDiagnosticAlarmType)}
    for ne107, (number, name) in ALARM_TYPES.items():
        types[ne107] = (await abstract.add_object_type(node(number), f"{index}:{name}")).nodeid
    return index, types


async def add_health(parent: Any, index: int, node: Any) -> Any:
    """Add the variable DeviceHealth to a node, and return it."""
    ua = import_ua()
    kind = ua.NodeId(ENUMERATION, index)
    return await parent.add_variable(node, f"{index}:DeviceHealth", 0, ua.VariantType.Int32, kind)


async def add_interface(asset: Any, index: int) -> None:
    """Say of an object that it has the interface of health."""
    ua = import_ua()
    await asset.add_reference(ua.NodeId(INTERFACE, index), ua.ObjectIds.HasInterface)

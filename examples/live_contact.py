"""Read the contact wrench in a loop, with a callback when something touches the tool."""

import ftdrive

released: list[ftdrive.Contact] = []


def on_contact(contact: ftdrive.Contact) -> None:
    """Print the beginning of a contact, 60 ms later, and its end."""
    if contact.over:
        print(f"released, peak {contact.peak_N:.0f} N")
        released.append(contact)
    else:
        print("contact")


# On your cell: open_stream(calibration="runs/…", on_contact=on_contact), with ./ftdrive.toml.
with ftdrive.open_stream(simulate=True, on_contact=on_contact) as stream:
    print(f"{stream.info.arm.model}, calibration {stream.info.calibration.verdict}")
    samples = iter(stream)
    begin_s, pushed = next(samples).t_s, False
    for sample in samples:  # force_N, torque_Nm, their sigmas, raw, in_contact, frame
        if sample.t_s > begin_s + 3 and not pushed:  # the noise of the free tool is known
            stream.station.control(do="push", wrench=[0, 0, -8, 0, 0, 0], seconds=1.0)
            pushed = True
        if released and sample.t_s > 1e-9 * released[0].last_ns + 1:
            print(f"free again: {sample.force_N.round() + 0.0} N, {sample.frame}")
            break

"""An exporter: the parameters of a material as a plain table."""


def export(material):
    rows = [f"{name} {value!r}" for name, value in material.parameters.items()]
    return "\n".join([material.law, *rows]) + "\n"

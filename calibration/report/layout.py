"""Layout of the reports: sizes of figures, numbers of drawn points and entries, limits of scales and labels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportLayoutSettings:
    """Settings of the layout of all reports: sizes of figures, numbers of drawn points, and limits of lists.

    Attributes:
        width: width of a figure that fills the page, inches. A larger width makes text smaller on the page.
        panels_per_row: largest number of panels in a row.
        legend_columns: largest number of columns of the legend above the panels.
        profile_legend_columns: the same above the profile likelihoods, whose entries are short.
        print_dpi: resolution of separate PNG files, dots per inch.
        formula_dpi: resolution of formulas, dots per inch: twice the 96 of CSS, for high-resolution screens.
        data_points: approximate maximum number of drawn points per recording; more points make larger files.
        dense_points: number of points of all recordings above which the markers are smaller.
        test_row_height: height of a row of panels in the figure of a test, inches.
        residual_row_height: height of the panels in the figure of a test of a diagnosis, inches.
        history_row_height: height of a row of panels with the convergence of the starts, inches.
        profile_row_height: height of a row of panels with profile likelihoods or specimens, inches.
        window_row_height: height of a row of panels with fits to a part of the strain, inches.
        correlation_height: height of the figure of up to four correlated parameters, inches.
        segment_height: height of the figure of the segments of a recording, inches.
        bar_height: height of a row of bars in a diagnosis, inches.
        frame_height: height of title, axis labels and legend around the bars, inches.
        specimen_width: width of one specimen in a panel, inches.
        residual_bins: bins over the duration (or displacement range) of a test in which residuals are averaged.
            More bins resolve shorter misfits and scatter more.
        margin: margin between the data and the frame, as a fraction of the range of the data.
        ignored_rates: fraction of rates at either end that is ignored for the scale of the axis.
        few_rates: number of rates up to which all of them count for the scale of the axis.
        min_labelled_width: minimum width of a region with a label in the residuals of a test, as a fraction of the
            panel width.
        min_two_line_width: the same for the labels of a diagnosis, which state the misfit before and after.
        max_label_characters: total number of characters of the tick labels above which the labels are rotated.
        note_characters: maximum length of a note in a figure, characters.
        two_line_regions: number of regions of a test from which misfit and probability are written in two lines.
        darkest_misfit: misfit that is drawn with the darkest colour, standard errors.
        max_linear_ratio: quotient of the largest and the smallest parameter ratio up to which the scale is linear.
        linear_deviations: standard deviations up to which the scale of a score is linear; logarithmic above.
        samples_before_contact: samples before contact in the detail view of the contact.
        fraction_after_contact: displacement after contact in the detail view, as a fraction of the largest displacement
            after contact.
        summary_misfits: maximum number of misfits in the summary of a calibration; the table lists all.
        summary_regions: maximum number of regions in the summary of a diagnosis; the figure shows all.
        drawn_effects: maximum number of effects in the figure of a diagnosis; the table lists all.
    """

    width: float = 12.0
    panels_per_row: int = 3
    legend_columns: int = 4
    profile_legend_columns: int = 6
    print_dpi: int = 300
    formula_dpi: int = 192
    data_points: int = 250
    dense_points: int = 400
    test_row_height: float = 3.15
    residual_row_height: float = 3.4
    history_row_height: float = 2.7
    profile_row_height: float = 3.1
    window_row_height: float = 2.6
    correlation_height: float = 4.2
    segment_height: float = 4.2
    bar_height: float = 0.3
    frame_height: float = 1.25
    specimen_width: float = 0.9
    residual_bins: int = 60
    margin: float = 0.06
    ignored_rates: float = 0.02
    few_rates: int = 200
    min_labelled_width: float = 0.11
    min_two_line_width: float = 0.16
    max_label_characters: int = 40
    note_characters: int = 90
    two_line_regions: int = 7
    darkest_misfit: float = 6.0
    max_linear_ratio: float = 5.0
    linear_deviations: float = 4.0
    samples_before_contact: int = 80
    fraction_after_contact: float = 0.12
    summary_misfits: int = 3
    summary_regions: int = 4
    drawn_effects: int = 14


#: Layout of all reports.
LAYOUT = ReportLayoutSettings()
